"""The layers, the places of heavy libraries, and the names of frames."""

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "visioncal"

# A package imports only from those above its own, and from itself.
LAYERS = (
    "core", "robot", "vision", "session", "estimation", "model", "fit", "dynamics", "results",
    "simulation", "calibration", "verification", "frames", "present", "planning", "live",
    "interchange", "cli",
)  # fmt: skip
# The session's loader hands recordings over; a result locates what its camera sees.
LAZY = {("session", "present"), ("results", "present"), ("results", "frames")}
# Boards are drawn as they are printed; lens, arm and solvers are its own.
SIMULATION_MAY_USE = ("core", "session", "simulation", "vision.targets", "vision.printing.pattern")
HOMES = {
    "rerun": {"present.recording", "present.viewer"},
    "pinocchio": {"robot"},
    "matplotlib": {"vision.printing", "present.report"},
    "jinja2": {"present"},
    "yaml": {"core.documents", "interchange.exports"},
    "typer": {"cli"},
    "rich": {"cli"},
    "depthai": {"live.drivers"},
    "rtde_control": {"live.drivers"},
    "rtde_receive": {"live.drivers"},
    "nicegui": {"live.page"},
    "dask": {"interchange.batch"},
    "distributed": {"interchange.batch"},
}


def modules():
    return sorted(PACKAGE.rglob("*.py"))


def package_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


def imports(path: Path):
    for node in nodes(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            names = [node.module] if node.module != "visioncal" else []
            yield from names or (f"visioncal.{alias.name}" for alias in node.names)


def packages_imported(path: Path):
    return {name.split(".")[1] for name in imports(path) if name.startswith("visioncal.")}


def test_the_listing_is_the_architecture():
    assert {path.parent.name for path in PACKAGE.glob("*/__init__.py")} == set(LAYERS)
    assert len(LAYERS) <= 18  # `model` and `fit` are to take the place of `estimation`
    assert {package_of(path) for path in modules()} == {*LAYERS, "__init__", "__main__"}


def test_packages_import_only_from_those_before():
    for path in modules():
        package = package_of(path)
        if package in LAYERS:
            later = set(LAYERS[LAYERS.index(package) + 1 :])
            wrong = {
                value for value in packages_imported(path) & later if (package, value) not in LAZY
            }
            assert not wrong, (path, wrong)


def test_no_file_is_over_500_lines():
    sizes = {path: len(path.read_text().splitlines()) for path in modules()}
    assert {str(path): size for path, size in sizes.items() if size > 500} == {}


def test_an_arm_moves_through_the_gate_alone():
    callers = {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("*.py")
        for line in path.read_text().splitlines()
        if ".start_move(" in line and "def " not in line
    }
    assert callers == {"live/capture/gate.py"}


def test_the_simulation_has_a_forward_model_of_its_own():
    for path in (PACKAGE / "simulation").glob("*.py"):
        ours = (name.removeprefix("visioncal.") for name in imports(path) if "visioncal." in name)
        assert all(name.startswith(SIMULATION_MAY_USE) for name in ours), path.name


def test_heavy_libraries_enter_in_one_place():
    for path in modules():
        for name in imports(path):
            homes = HOMES.get(name.split(".")[0])
            within = ".".join(path.relative_to(PACKAGE).parts)
            assert homes is None or within.startswith(tuple(homes)), (path, name)


# Number of the heart's modules that a shelf of satellites imports. Each shall need `calibrate`,
# `detect` and types alone: its ceiling falls, to 6 for frames and planning, 4 for formats, and 2.
HEART = ("calibration", "estimation", "model", "fit")
CEILINGS = {
    "live.drivers": 0, "live.capture": 0, "live.page": 1, "planning": 6, "live.simulated": 0,
    "present": 0, "interchange.exports": 0, "interchange.formats": 5, "interchange.batch": 1,
    "simulation": 0, "dynamics": 0, "frames": 6, "verification": 10,
    "results.history": 0,
}  # fmt: skip


@cache
def graph() -> dict[str, set[str]]:
    """Modules of visioncal, and those that each imports."""
    files = {".".join(path.relative_to(PACKAGE).with_suffix("").parts): path for path in modules()}
    names = {f"visioncal.{name}".removesuffix(".__init__"): name for name in files}
    found = {}
    for name, path in files.items():
        given = set()
        for node in nodes(path):
            if isinstance(node, ast.Import):
                given |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                inner = {f"{node.module}.{alias.name}" for alias in node.names}
                given |= inner & names.keys() or {node.module}
        found[name] = {names[each] for each in given & names.keys()} - {name}
    return found


def shelf(imported: dict[str, set[str]], name: str) -> set[str]:
    """Modules of the heart that a package's or a module's files import."""
    files = {each for each in imported if each == name or each.startswith(f"{name}.")}
    needed = set().union(*(imported[each] for each in files)) - files
    return {each for each in needed if each.startswith(tuple(f"{part}." for part in HEART))}


def circles(imported: dict[str, set[str]]) -> list[set[str]]:
    """Circles of modules: those that reach each other."""
    reach = {name: set(direct) for name, direct in imported.items()}
    for middle in reach:
        for name in reach:
            if middle in reach[name]:
                reach[name] |= reach[middle]
    found = {
        frozenset(other for other in reach[name] if name in reach[other])
        for name in reach
        if name in reach[name]
    }
    return [set(each) for each in found]


def test_shelves_import_ever_less_of_the_heart():
    counts = {name: len(shelf(graph(), name)) for name in CEILINGS}
    assert {name: count for name, count in counts.items() if count > CEILINGS[name]} == {}


def test_no_modules_import_each_other_in_a_circle():
    assert circles(graph()) == []


def test_another_import_of_the_heart_or_circle_is_found():
    imported = {"live.drivers.ur": {"fit.solve"}, "fit.solve": {"core.types"}, "core.types": set()}
    assert shelf(imported, "live.drivers") == {"fit.solve"}
    assert circles(imported) == []
    assert circles(imported | {"core.types": {"fit.solve"}}) == [{"fit.solve", "core.types"}]


# What is imported one after the other by a process, and what is not loaded by then.
SMALL = (
    # Every command waits for what is loaded here, `--help` and `--version` too.
    ("visioncal", {"numpy", "typer", "visioncal.core.types"}),
    (
        "visioncal.cli.app, visioncal.cli.session_options, visioncal.cli.result_options, "
        "visioncal.cli.frame_options, visioncal.cli.dynamics_options",
        {"numpy", "rich", "visioncal.core.types"},
    ),
    # A finished batch starts no solver, and draws nothing.
    (
        "visioncal.interchange.batch, visioncal.present.report.fleet, visioncal.cli.batch",
        {"matplotlib", "rerun", "scipy.optimize", "scipy.sparse.csgraph", "distributed"}
        | {"visioncal.calibration.pipeline", "visioncal.calibration.stages"},
    ),
    # A place of a pixel is a millisecond's work.
    (
        "visioncal.frames.locate, visioncal.interchange.result_files",
        {"rerun", "pinocchio", "coal", "matplotlib", "scipy.optimize", "scipy.signal"}
        | {"scipy.stats", "visioncal.calibration.pipeline", "visioncal.dynamics"},
    ),
)
CALIBRATING = (
    # A calibration waits for no plots, and for nothing that few sessions need.
    (
        "visioncal.calibration.run, visioncal.frames, visioncal.interchange.outputs",
        {"matplotlib", "rerun", "pinocchio", "torch", "jinja2", "yaml", "defusedxml"}
        | {"xml.sax", "urllib.request", "scipy.optimize", "scipy.fft", "scipy.sparse.csgraph"}
        | {"scipy.stats", "scipy.ndimage", "scipy.signal", "scipy.interpolate"}
        | {"visioncal.robot.writing", "visioncal.vision.dense"}
        | {"visioncal.core.documents.structured"},
    ),
    # A report by itself waits for no library of recordings.
    ("visioncal.present.report.page", {"rerun", "pyarrow"}),
    # Calibrating a session drives no robot, and simulates none.
    (
        "visioncal.present.recording, visioncal.cli.summary",
        {"visioncal.dynamics", "visioncal.live", "visioncal.simulation"},
    ),
    (
        "visioncal.cli.record",
        {"depthai", "rtde_control", "rtde_receive", "harvesters", "genicam", "pypylon"}
        | {"pyrealsense2", "nicegui", "visioncal.live.page"},
    ),
)


@pytest.mark.parametrize("steps", [SMALL, CALIBRATING], ids=["small", "calibrating"])
def test_heavy_libraries_are_loaded_where_they_are_needed(steps):
    code = "import sys\n" + "".join(
        f"import {imported}\nprint(sorted({unwanted} & set(sys.modules)))\n"
        for imported, unwanted in steps
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["[]"] * len(steps)


FRAMES = re.compile(r"^_?(?P<parent>[a-z]\w*?)_from_(?P<child>[a-z]\w*)$")


def ends(node: ast.AST, path: Path = PACKAGE):
    """(parent, child) frames of an expression, None where its names do not tell."""
    if isinstance(node, ast.Name | ast.Attribute):
        match = FRAMES.match(node.id if isinstance(node, ast.Name) else node.attr)
        return (match["parent"], match["child"]) if match else None
    if isinstance(node, ast.Subscript):
        return ends(node.value, path)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name | ast.Attribute):
        name = node.func.id if isinstance(node.func, ast.Name) else node.func.attr
        inner = ends(node.args[0], path) if name == "invert" and len(node.args) == 1 else None
        return inner and (inner[1], inner[0])
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
        left, right = ends(node.left, path), ends(node.right, path)
        if left and right:
            assert left[1] == right[0], f"{path}:{node.lineno}: {ast.unparse(node)}"
            return left[0], right[1]
    return None


def test_inner_names_of_frames_cancel():
    for path in modules():
        for node in nodes(path):
            if isinstance(node, ast.BinOp):
                ends(node, path)
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.BinOp | ast.Call):
                wanted, found = ends(node.targets[0], path), ends(node.value, path)
                if wanted and found:
                    assert wanted == found, f"{path}:{node.lineno}: {ast.unparse(node)}"


def test_the_check_of_names_can_fail():
    with pytest.raises(AssertionError):
        ends(ast.parse("base_from_flange @ cam_from_target").body[0].value)
    chain = "invert(flange_from_base) @ flange_from_cam @ cam_from_target[0]"
    assert ends(ast.parse(chain).body[0].value) == ("base", "target")


# What data determine, devices report and files state: "told" hides which of these it is. A variable
# says what it is, too.
VAGUE = {"tell", "tells", "told", "untold", "telling", "worth", "lacking", "wishes"}


def identifiers(found_nodes):
    for node in found_nodes:
        for name in ("id", "attr", "arg", "name", "asname"):
            if isinstance(found := getattr(node, name, None), str):
                yield found


# Pronouns and adverbs, which do not say the thing that they name.
PRONOUNS = {
    *["it", "own", "mine", "ours", "theirs", "whose", "both", "beside", "here", "there", "alone"]
}


def test_names_have_the_terms_of_the_field():
    for path in modules():
        vague = {
            identifier
            for identifier in identifiers(nodes(path))
            if identifier in PRONOUNS or VAGUE & set(identifier.lower().split("_"))
        }
        assert not vague, (path, vague)


RELATIVE = re.compile(r"(?:\"\"\"|# )(?:What|Which|That) ")
# A docstring that begins so has a subject in another one, or none.
PRONOUN = re.compile(r"\"\"\"(?:As|By|In|It|Its|Of|Theirs?|These|They|Those|With) ")


def test_no_docstring_or_comment_begins_with_a_relative_clause():
    for path in modules():
        for at, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            is_heading = '"## What' in line
            assert is_heading or not RELATIVE.search(line), f"{path}:{at}: {line.strip()}"
            assert not PRONOUN.search(line), f"{path}:{at}: {line.strip()}"


def test_no_test_is_named_by_a_relative_clause():
    for path in sorted((PACKAGE.parent / "tests").rglob("test_*.py")):
        found = re.findall(r"def (test_(?:what|which|that)_\w+)", path.read_text(encoding="utf-8"))
        assert not found, (path, found)


# A later sentence of a text; questions may begin so.
LATER = re.compile(r"[.!] (?!What to do next)(?:What|Which|That) [^.?|]*(?:[.|]|$)")


def texts(path: Path):
    """Docstrings of a module, or paragraphs of a page without its examples, each in one line."""
    if path.suffix == ".md":
        prose = re.sub(r"^(?: {4}|```).*$", "", path.read_text(encoding="utf-8"), flags=re.M)
        yield from (" ".join(part.split()) for part in prose.split("\n\n"))
        return
    for node in nodes(path):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            yield " ".join((ast.get_docstring(node) or "").split())


@pytest.mark.parametrize("folder", ["visioncal", ".github", "docs"])
def test_no_later_sentence_begins_with_a_relative_clause(folder):
    for path in sorted((PACKAGE.parent / folder).rglob("*.*")):
        is_read = path.suffix in (".py", ".md") and path.name != "CHANGELOG.md"
        for text in texts(path) if is_read else ():
            found = LATER.search(text)
            assert found is None, f"{path}: {found and found[0]}"


def test_a_relative_clause_amid_a_text_is_found():
    assert LATER.search("It is held. What is clipped stays, too.")
    assert not LATER.search("It is held. Which one is meant? That of a cell, or its own?")
