"""Every entry of a registry is found where a user and a contributor look for it.

An entry is one file and one line of a registry. Help, the pages' tables, printed commands and the
tests' own readers follow from it, or are named here as what is left out.
"""

import ast
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

from support.commands import visioncal
from support.makers import MAKERS
from support.readers import FIXTURE_READERS, READERS, TOOL_READERS

from visioncal.calibration.suspects.registry import SUSPECTS
from visioncal.cli.app import app
from visioncal.core.choices import POSE_FORMS, UNITS_M
from visioncal.interchange.exports import EXPORT_FORMATS
from visioncal.interchange.formats.registry import FOREIGN_FORMATS
from visioncal.live.capture.devices import ARMS, CAMERAS
from visioncal.model.effects import EFFECTS, NAMED, Effect
from visioncal.vision.boards import KINDS

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "visioncal"


@cache
def page(path):
    return (ROOT / path).read_text(encoding="utf-8")


@cache
def help_of(*command):
    done = visioncal(*command, "--help")
    assert done.status == 0
    # A line ends within a name at its hyphens and bars.
    return re.sub(r"\s*\n\s*", " ", done.out), re.sub(r"\s*\n\s*", "", done.out)


def in_help(name, *command):
    return any(
        re.search(rf"(?<![\w-]){re.escape(name)}(?![\w-])", text) for text in help_of(*command)
    )


def cells(path):
    """Names in quotes of code in the first cell of a page's tables."""
    rows = re.findall(r"^\| (`.*?) \|", page(path), re.MULTILINE)
    return {name for row in rows for name in re.findall(r"`([^`]+)`", row)}


@cache
def text_of_tests(*folders):
    """The text of all tests of some packages."""
    paths = (path for folder in folders for path in (ROOT / "tests" / folder).rglob("test_*.py"))
    return "\n".join(map(page, sorted(paths)))


def export_faults(formats):
    """Exports that a page, the listing or the tests leave out."""
    listing = visioncal("export", "--list").out
    table = cells("visioncal/interchange/README.md")
    read = {*READERS, *TOOL_READERS, *FIXTURE_READERS}
    for form in formats:
        if form.name not in table:
            yield f"{form.name}: no row in the table of visioncal/interchange/README.md"
        if not re.search(rf"^ *{re.escape(form.name)}\s", listing, re.MULTILINE):
            yield f"{form.name}: not in visioncal export --list"
        is_read = form.name in read or re.search(
            rf"\"{form.name}\"",
            page("tests/interchange/test_exports.py") + page("tests/support/readers.py"),
        )
        if not is_read:
            yield f"{form.name}: no reader of tests/support/readers.py reads it"


def maker_faults(forms):
    """Makers whose form is left out by help, pages, exports, or a printed command."""
    exports = {form.name for form in EXPORT_FORMATS}
    for form in forms:
        if not in_help(form.name, "convert"):
            yield f"{form.name}: not in visioncal convert --help"
        if form.name not in cells("visioncal/results/README.md"):
            yield f"{form.name}: no row in the table of visioncal/results/README.md"
        if f"`{form.name}`" not in page("visioncal/interchange/README.md"):
            yield f"{form.name}: not among the forms of visioncal/interchange/README.md"
        if not form.models:
            continue
        if form.name not in MAKERS:
            yield f"{form.name}: not in tests/support/makers.py, from its manual"
        if form.name not in exports:
            yield f"{form.name}: the verdict prints export --to {form.name}, which is refused"


def unit_faults(units):
    """Units of length that help or the page of imports leave out."""
    for name in units:
        if not in_help(name, "convert"):
            yield f"{name}: not in visioncal convert --help"
        if f"`{name}`" not in page("visioncal/interchange/README.md"):
            yield f"{name}: not among the units of visioncal/interchange/README.md"


def device_faults(arms, cameras):
    """Devices that help or the page of recording leave out."""
    text = page("visioncal/live/README.md")
    for option, names in (("arm", arms), ("camera", cameras)):
        for name in names:
            if not in_help(name, "record"):
                yield f"--{option} {name}: not in visioncal record --help"
            if not re.search(rf"`(?:--{option} )?{name}[:`]|--{option} {name}\b", text):
                yield f"--{option} {name}: not in visioncal/live/README.md"


def kind_faults(kinds):
    """Kinds of boards that `target make` or the page of boards leave out."""
    for name, kind in kinds.items():
        if kind.options and not in_help(name, "target", "make"):
            yield f"{name}: not among --kind of vision/board_request.py"
        if f'"{name}"' not in text_of_tests("vision"):
            yield f"{name}: no board of this kind in tests/vision, as in test_printing.py"
        if f'"{name}"' not in page("visioncal/vision/README.md"):
            yield f"{name}: not among the kinds of visioncal/vision/README.md"
        file = "points" if name == "points" else name
        if not list((PACKAGE / "vision/boards").glob(f"{file}.py")):
            yield f"{name}: no file visioncal/vision/boards/{file}.py"


@cache
def commands():
    """Names of all commands: `export`, `target make`."""
    group = app.info.cls
    names = [name for listed in group.listed.values() for name in listed]
    inner = {name: group.groups[name].info.cls.listed for name in names if name in group.groups}
    return [
        *(name for name in names if name not in inner),
        *(
            f"{name} {each}"
            for name, listed in inner.items()
            for row in listed.values()
            for each in row
        ),
    ]


def command_faults(names):
    """Commands that no page shows."""
    pages = "\n".join(page(path.relative_to(ROOT)) for path in PACKAGE.glob("*/README.md"))
    for name in names:
        if not re.search(rf"visioncal {name}\b", pages + page("README.md")):
            yield f"visioncal {name}: no row in the table of visioncal/cli/README.md"


@cache
def raised_kinds():
    """Kinds of findings by the literal first argument of `Finding(...)`, with their places."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Finding":
                kind = node.args[0] if node.args else None
                if isinstance(kind, ast.Constant):
                    found.setdefault(kind.value, path.relative_to(PACKAGE).as_posix())
    return found


# Findings that no contest ranks: of other verdicts, and of what is compared after a calibration's.
OF_OTHERS = (
    *("verification/", "verification/recovery.py", "verification/loaded.py", "frames/"),
    *("calibration/pipeline/checkup.py", "calibration/stages/depth.py", "dynamics/"),
)


def finding_faults(kinds):
    """Kinds that a calibration raises, and no registry has: ranking them is a KeyError."""
    for kind, place in kinds.items():
        if kind not in SUSPECTS and not place.startswith(OF_OTHERS):
            yield f"{kind}: raised in {place}, not in calibration/suspects/registry.py"


def kinds_below(effect):
    """Names of kinds that derive from a class of effects, in the package."""
    for each in effect.__subclasses__():
        if hasattr(each, "kind") and each.__module__.startswith("visioncal."):
            yield each.kind
        yield from kinds_below(each)


def effect_faults(kinds, effects):
    """Effects without a clause, a page or an import, and named ones that are in no test."""
    for kind in {*kinds_below(Effect)} - kinds.keys():
        yield f"{kind}: not imported by model/effects/__init__.py, from which its clause is found"
    for kind, effect in kinds.items():
        if not hasattr(effect, "clause"):
            yield f"{kind}: no clause says what it does"
        if kind not in page("visioncal/model/README.md"):
            yield f"{kind}: not among the kinds of visioncal/model/README.md"
    for effect in effects:
        kind = effect.kind.replace(" ", "_")
        if kind not in SUSPECTS:
            yield f"{kind}: no suspect has its kind"
        if f'"{kind}"' not in text_of_tests("calibration") and effect.__name__ not in text_of_tests(
            "fit"
        ):
            yield f"{kind}: in no world of tests/calibration/test_worlds.py"
        if not effect.__module__.startswith("visioncal.model.effects."):
            yield f"{kind}: no file in model/effects"


def import_faults(formats):
    """Formats that can be asked for by `--from`, and are not listed there."""
    for form in formats:
        if not in_help(form.name, "convert") and f"`{form.name}`" not in page(
            "visioncal/interchange/README.md"
        ):
            yield f"{form.name}: neither in convert --help nor in visioncal/interchange/README.md"


def contributing_faults(text):
    """Rows of CONTRIBUTING's table whose files, registry or neighbour are absent."""
    rows = re.findall(
        r"^\| (an? .*?) \| (.*?) \| (.*?) \| (.*?) ?\| `(.*?)` \|$", text, re.MULTILINE
    )
    assert len(rows) >= 15
    for added, place, entry, neighbour, test in rows:
        (home,), names = re.findall(r"`([^`]+)`", place), re.findall(r"`([^`]+)`", entry)
        folder, files = PACKAGE / home, [PACKAGE / name for name in names if "/" in name]
        searched = files or [folder / "__init__.py" if folder.is_dir() else folder]
        of_folder = folder.is_dir()
        needed = [folder, *files, ROOT / test]
        copied = re.findall(r"`([^`]+)`", neighbour)
        needed += [folder / name for name in copied if of_folder]
        yield from (f"{added}: there is no {path}" for path in needed if not path.exists())
        defined = [name for name in names if "/" not in name] + copied * (not of_folder)
        texts = "\n".join(file.read_text(encoding="utf-8") for file in searched if file.exists())
        for name in defined:
            if not re.search(rf"^(?:def )?{name}\b", texts, re.MULTILINE):
                yield f"{added}: no {name} in {searched}"


def test_every_entry_is_where_a_user_looks():
    faults = [
        *export_faults(EXPORT_FORMATS),
        *maker_faults(POSE_FORMS.values()),
        *unit_faults(UNITS_M),
        *device_faults(ARMS, CAMERAS),
        *kind_faults(KINDS),
        *command_faults(commands()),
        *finding_faults(raised_kinds()),
        *effect_faults(EFFECTS, NAMED),
        *import_faults(FOREIGN_FORMATS),
        *contributing_faults(page(".github/CONTRIBUTING.md")),
    ]
    assert not faults, "\n".join(faults)


def test_an_entry_that_is_left_out_is_found():
    export, maker = EXPORT_FORMATS[0], POSE_FORMS["xarm"]
    assert len([*export_faults([replace(export, name="no-such")])]) == 3
    # Form, pages, manual: a maker's export follows from its form.
    assert len([*maker_faults([replace(maker, name="no-such")])]) == 5
    assert len([*unit_faults(["no-such"])]) == 2
    assert len([*device_faults(["no-such"], ["no-such-cam"])]) == 4
    assert len([*kind_faults({"no-such": KINDS["charuco"]})]) == 4
    assert len([*command_faults(["no-such"])]) == 1
    assert len([*finding_faults({"no-such": "calibration/stages/no_such.py"})]) == 1
    assert len([*effect_faults({**EFFECTS, "no such": object}, [])]) == 2
    assert len([*effect_faults({k: v for k, v in EFFECTS.items() if k != "play"}, [])]) == 1
    assert len([*import_faults([replace(FOREIGN_FORMATS[0], name="no-such")])]) == 1
    text = page(".github/CONTRIBUTING.md")
    for entry in ("`STAGES`", "`marker.py`", "`_axes`", "`tests/cli/test_cli.py`"):
        assert len([*contributing_faults(text.replace(entry, f"`absent{entry[1:]}"))]) == 1
