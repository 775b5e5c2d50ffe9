"""The dashboard server of a simulated controller: one line asks, one line answers.

Source: Universal Robots, "Dashboard Server e-Series".
"""

from visioncal.live.rehearsal.machine import Machine

DASHBOARD_PORT = 29999
BANNER = "Connected: Universal Robots Dashboard Server"
_SAFETY = {
    "normal": "NORMAL",
    "protective-stop": "PROTECTIVE_STOP",
    "emergency-stop": "ROBOT_EMERGENCY_STOP",
}


def answer(machine: Machine, line: str, now_s: float) -> str:
    """Answers one line of a client, and does what it orders."""
    asked = line.strip().lower()
    state = _state(machine, asked)
    if state is not None:
        return state
    if asked == "stop":
        machine.stop_program(now_s)
        return "Stopped"
    if asked == "unlock protective stop":
        machine.release()
        return "Protective stop releasing"
    if asked == "power off":
        machine.stop_program(now_s)
        machine.mode = "POWER_OFF"
        return "Powering off"
    if asked in ("power on", "brake release"):
        machine.mode = "RUNNING"
        return "Powering on" if asked == "power on" else "Brake releasing"
    if asked.startswith(("popup", "close popup", "close safety popup", "addtolog")):
        return "ok"
    return f"could not understand: '{line.strip()}'"


def _state(machine: Machine, asked: str) -> str | None:
    """Answers a question; None where it is none."""
    playing = machine.program == "playing"
    answers = {
        "polyscopeversion": machine.polyscope,
        "get serial number": "20235500001",
        # The model's name without its series, as the real one.
        "get robot model": machine.believed.name.removesuffix("e").upper(),
        "is in remote control": str(machine.remote).lower(),
        "robotmode": f"Robotmode: {machine.mode}",
        "safetymode": f"Safetymode: {_SAFETY[machine.safety]}",
        "safetystatus": f"Safetystatus: {_SAFETY[machine.safety]}",
        "running": f"Program running: {str(playing).lower()}",
        "programstate": f"{machine.program.upper()} rtde_control",
        "quit": "Disconnected",
    }
    return answers.get(asked)
