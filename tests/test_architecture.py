"""The layers, the places of heavy libraries, and the names of frames."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "visioncal"

# A module imports only from the layers above its own, and from its own.
LAYERS = (
    ("version",),
    ("errors",),
    ("types",),
    ("chance",),
    ("figures",),
    ("transforms",),
    ("asides", "threads"),
    ("files",),
    ("generations",),
    ("conventions",),
    ("documents",),
    ("camera",),
    ("robot",),
    ("instruments",),
    ("targets",),
    ("prints",),
    ("printing",),
    ("finders",),
    ("dense",),
    ("solvers",),
    ("estimation",),
    ("session",),
    ("evidence",),
    ("thermal",),
    ("dynamics",),
    ("calibration",),
    ("compensation",),
    ("compare",),
    ("recording",),
    ("simulation",),
    ("guess",),
    ("stages",),
    ("pipeline",),
    ("frames",),
    ("planning", "report", "viewer", "drivers"),
    ("capture",),
    ("rehearsal",),
    ("verification",),
    ("outputs",),
    ("stored", "formats", "exports"),
    ("joining",),
    ("cli",),
    ("__main__",),
)
# The session's loader hands recordings over; the package's front hands out names on first use.
LAZY = {("session", "recording")}
SIMULATION_MAY_USE = {"errors", "types", "transforms", "files", "threads", "session", "simulation"}
HOMES = {
    "rerun": {"recording", "viewer"},
    "pinocchio": {"robot"},
    "matplotlib": {"printing", "report"},
    "jinja2": {"report"},
    "pydantic": {"session"},
    "yaml": {"documents", "exports"},
    "typer": {"cli"},
    "rich": {"cli"},
    "depthai": {"drivers"},
    "rtde_control": {"drivers"},
    "rtde_receive": {"drivers"},
    "torch": {"dense"},
    "kornia": {"dense"},
}


def modules():
    return sorted(PACKAGE.rglob("*.py"))


def layer_name(path: Path) -> str:
    first = path.relative_to(PACKAGE).parts[0]
    return first.removesuffix(".py")


def imports(path: Path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            names = [node.module] if node.module != "visioncal" else []
            yield from names or (f"visioncal.{alias.name}" for alias in node.names)


def test_every_module_belongs_to_a_layer():
    known = {name for layer in LAYERS for name in layer} | {"__init__"}
    assert {layer_name(path) for path in modules()} == known


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_only_from_the_layers_before(path):
    own = layer_name(path)
    if own == "__init__":
        return
    rank = {name: at for at, layer in enumerate(LAYERS) for name in layer}
    used = {name.split(".")[1] for name in imports(path) if name.startswith("visioncal.")}
    later = {it for it in used if rank[it] > rank[own] and (own, it) not in LAZY}
    beside = {it for it in used if rank[it] == rank[own] and it != own}
    assert not later
    assert not beside


def test_the_simulation_has_a_forward_model_of_its_own():
    for path in (PACKAGE / "simulation").glob("*.py"):
        used = {name.split(".")[1] for name in imports(path) if name.startswith("visioncal.")}
        assert used <= SIMULATION_MAY_USE, path.name


def test_heavy_libraries_enter_in_one_place():
    for path in modules():
        for name in imports(path):
            top = name.split(".")[0]
            assert layer_name(path) in HOMES.get(top, {layer_name(path)}), (path, top)


@pytest.mark.parametrize(
    ("imported", "unwanted"),
    [
        (
            "visioncal.cli, visioncal.pipeline",
            {"depthai", "rtde_control", "rtde_receive", "torch", "kornia"},
        ),
        # Every command waits for what is loaded here, `--help` too.
        (
            "visioncal.cli.app",
            {"rerun", "pinocchio", "coal", "matplotlib", "scipy.signal", "scipy.stats"},
        ),
    ],
)
def test_heavy_libraries_are_loaded_where_they_are_needed(imported, unwanted):
    code = f"import sys, {imported}; print(sorted({unwanted} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


FRAMES = re.compile(r"^_?(?P<parent>[a-z]\w*?)_from_(?P<child>[a-z]\w*)$")


def ends(node: ast.AST):
    """(parent, child) frames of an expression, None where its names do not tell."""
    if isinstance(node, ast.Name | ast.Attribute):
        match = FRAMES.match(node.id if isinstance(node, ast.Name) else node.attr)
        return (match["parent"], match["child"]) if match else None
    if isinstance(node, ast.Subscript):
        return ends(node.value)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name | ast.Attribute):
        name = node.func.id if isinstance(node.func, ast.Name) else node.func.attr
        inner = ends(node.args[0]) if name == "invert" and len(node.args) == 1 else None
        return inner and (inner[1], inner[0])
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
        left, right = ends(node.left), ends(node.right)
        if left and right:
            assert left[1] == right[0], f"line {node.lineno}: {ast.unparse(node)}"
            return left[0], right[1]
    return None


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_inner_names_cancel(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.BinOp):
            ends(node)
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.BinOp | ast.Call):
            wanted, found = ends(node.targets[0]), ends(node.value)
            if wanted and found:
                assert wanted == found, f"line {node.lineno}: {ast.unparse(node)}"


def test_the_check_of_names_can_fail():
    with pytest.raises(AssertionError):
        ends(ast.parse("base_from_flange @ cam_from_target").body[0].value)
    chain = "invert(flange_from_base) @ flange_from_cam @ cam_from_target[0]"
    assert ends(ast.parse(chain).body[0].value) == ("base", "target")
