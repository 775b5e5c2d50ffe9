"""Checks what JSON that was read holds, before anything is computed or drawn from it."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, TypeAlias

# What a value has to be: a type (float stands for any number); a list of a form, however
# long; or a mapping of keys to forms, of which those that end in ? may be absent. The key "" is any
# key, and keys that are not named are free.
Form: TypeAlias = "type | list[Any] | Mapping[str, Any]"

# Of all results of a calibration.
SCHEMA = 1
_WORDS = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}
_RMS: Form = {"mm": float, "deg?": float, "px?": float}
VERDICT: Form = {
    "status": str,
    "reasons": [str],
    "good_for_mm?": float,
    "causes?": [
        {"cause": str, "probability": float, "sentence": str, "without_it?": str, "do?": str}
    ],
    "findings?": [
        {
            "kind": str,
            "words": str,
            "do?": {"words": str, "command?": str},
            "views?": [int],
            "probability?": float,
            "without_it?": str,
        }
    ],
}
_NEED: Form = {
    "mm?": float,
    "deg?": float,
    "probability": float,
    "pairs?": [{"camera": str, "robot": str, "probability": float}],
}
FRAME: Form = {
    "oriented": bool,
    "method": str,
    "source": str,
    "created": str,
    "rms_mm": float,
    "noise_mm": float,
    "observations": [
        {"name": str, "used": bool, "reason?": str, "kind?": str, "residual_mm?": float}
    ],
    "verdict": VERDICT,
    "details": {},
}
CAMERA: Form = {"resolution": [int], "model": str, "estimated": bool}
VIEW: Mapping[str, Any] = {
    "view": int,
    "used": bool,
    "reason?": str,
    "corners?": int,
    "rms_px?": float,
    "residual_mm?": float,
    "residual_deg?": float,
}
CALIBRATION: Form = MappingProxyType(
    {
        "created": str,
        "session": {"name": str, "sha256": str},
        "transforms": {"": {}},
        "solvers": {"": {"rms_mm": float, "rms_deg?": float}},
        "camera?": CAMERA,
        "noise": {"": float},
        "views": [VIEW],
        "rms": _RMS,
        "validation": {"method": str, "held_out": _RMS, "holdout?": _RMS},
        "verdict": VERDICT,
        "need?": _NEED,
        "frames?": {"": FRAME},
    }
)
MOVED: Form = {
    "frame": str,
    "before": str,
    "shift_mm": float,
    "turn_deg": float,
    "rivals": [str],
}
UNTIED: Form = {"frame": str, "remedy": str}
WHOLE: Form = MappingProxyType(
    {
        "created": str,
        "session": {"name": str, "sha256": str},
        "reference": str,
        "tree": {"": str},
        "transforms": {"": {}},
        "cameras": {"": CAMERA},
        "robots": {"": {}},
        "targets": {"": {}},
        "noise": {"": {"": float}},
        "views": [
            {
                **VIEW,
                "stop": int,
                "robots": [str],
                "camera?": str,
                "instrument?": str,
                "target?": str,
                "point?": str,
            }
        ],
        "moved": [MOVED],
        "untied": [UNTIED],
        "weakest": str,
        "verdict": VERDICT,
        "need?": _NEED,
        "frames?": {"": FRAME},
        "validation?": {"method": str, "held_out": _RMS, "holdout?": _RMS, "pairs": [_RMS]},
    }
)


def check(document: object, form: Form, path: str = "") -> None:
    """Checks a value of a JSON document.

    Args:
        document: The value.
        form: What it has to be.
        path: Where it stands, for the message.

    Raises:
        ValueError: It is something else; the message names the place, what is there and what is
            needed.
    """
    if isinstance(form, type):
        _check_plain(document, form, path)
    elif isinstance(form, list):
        if not isinstance(document, list):
            raise _other(document, "a list", path)
        for at, value in enumerate(document):
            check(value, form[0], f"{path}[{at}]")
    else:
        if not isinstance(document, dict):
            raise _other(document, "a table", path)
        for name, inner in form.items():
            key = name.removesuffix("?")
            named = document if not key else {key: document[key]} if key in document else {}
            if not named and key == name != "":
                raise ValueError(f"{path}.{key} is missing".lstrip("."))
            for it, value in named.items():
                check(value, inner, f"{path}.{it}".lstrip("."))


def _check_plain(value: object, kind: type, path: str) -> None:
    kinds = (int, float) if kind is float else (kind,)
    if not isinstance(value, kinds) or (isinstance(value, bool) and kind is not bool):
        raise _other(value, _WORDS[kind], path)


def _other(value: object, needed: str, path: str) -> ValueError:
    return ValueError(f"{path or 'the document'} is {value!r:.60}; {needed} is needed")
