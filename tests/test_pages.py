"""The pages are true of the program: their links, commands, names, paths and quotations."""

import csv
import re
import shlex
from dataclasses import fields
from functools import cache
from importlib import import_module
from pathlib import Path

import cv2
import pytest
import typer
from support.commands import every_command
from support.recipes import BLOCK, FOLDER

import visioncal
from visioncal import dynamics
from visioncal.calibration.suspects.registry import SUSPECTS
from visioncal.core.codec import entries
from visioncal.results.document import CalibrationForm
from visioncal.results.sections import CalibrationSections

ROOT = Path(__file__).parents[1]
COMMANDS = dict(every_command())
FRONT, AROUND = ROOT / "README.md", sorted((ROOT / "docs").glob("*.md"))
PACKAGES = sorted(path.parent for path in (ROOT / "visioncal").glob("*/__init__.py"))
PAGES = [
    FRONT,
    *AROUND,
    ROOT / "visioncal" / "README.md",
    *(package / "README.md" for package in PACKAGES),
    *sorted(FOLDER.glob("*.md")),
    *sorted((ROOT / ".github").glob("*.md")),
]
every_page = pytest.mark.parametrize("page", PAGES, ids=lambda value: str(value.relative_to(ROOT)))

LINK = re.compile(r"\]\(([^)\s]+)\)")
# An indented line after an empty one, or within an indented block, is code.
INDENTED = re.compile(r"(?:^ {4,}\S.*\n)+", re.MULTILINE)
SPAN = re.compile(r"`([^`]+)`")
# Where a command of ours begins, and where the shell's business begins again.
COMMAND = re.compile(r"(?:^|\$ |&& )visioncal (.*)")
SHELL = re.compile(r" (?:\|\||&&|\||>\S*)(?: |$)")


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


@cache
def code_of(page: Path) -> tuple[str, ...]:
    """The blocks of code of a page, fenced ones and indented ones."""
    text = text_of(page)
    fenced = re.findall(r"^ *```.*?\n(.*?)^ *```", text, re.MULTILINE | re.DOTALL)
    plain = re.sub(r"^ *```.*?^ *```", "", text, flags=re.MULTILINE | re.DOTALL)
    return (*fenced, *INDENTED.findall(plain))


@cache
def spans_of(page: Path) -> tuple[str, ...]:
    """What a page has between single backticks, line breaks taken out."""
    plain = re.sub(r"^ *```.*?^ *```", "", text_of(page), flags=re.MULTILINE | re.DOTALL)
    return tuple(" ".join(value.split()) for value in SPAN.findall(INDENTED.sub("", plain)))


def anchors(page: Path) -> set[str]:
    """Names of a page's headings, as links call them."""
    heads = re.findall(r"^#+ (.*)$", text_of(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


def words_of(line: str) -> list[str]:
    return [part for part in shlex.split(SHELL.split(line)[0], comments=True) if part != "..."]


@cache
def commands_of(page: Path) -> tuple[tuple[str, ...], ...]:
    """The words of each command line in the code of a page."""
    lines = "\n".join(code_of(page)).replace("\\\n", " ").splitlines()
    found = [COMMAND.search(line.strip()) for line in lines]
    return tuple(tuple(words_of(match[1])) for match in found if match)


@cache
def mentions_of(page: Path) -> tuple[tuple[str, ...], ...]:
    """The words of each command that a page has in its sentences."""
    found = [COMMAND.match(span) for span in spans_of(page)]
    return tuple(tuple(words_of(match[1])) for match in found if match)


def command_of(words: tuple[str, ...]) -> tuple[typer.core.TyperCommand, list[str], str]:
    """The command that words begin with, what follows, and its name."""
    for count in (1, 2):
        name = " ".join(words[:count])
        if command := COMMANDS.get(name):
            return command, list(words[count:]), name
    raise AssertionError(f"visioncal {' '.join(words)} names no command")


def parse(words: tuple[str, ...], *, whole: bool) -> None:
    """Parses a command line without running it."""
    command, left, name = command_of(words)
    try:
        if whole:
            command.make_context(name, left)
            return
        _, rest, _ = command.make_parser(command.context_class(command)).parse_args(left)
    except Exception as error:  # typer's, whose module differs between its versions
        raise AssertionError(f"visioncal {' '.join(words)}: {error}") from error
    assert not rest, f"visioncal {' '.join(words)}: {rest}"


@every_page
def test_links_lead_somewhere(page):
    for link in LINK.findall(text_of(page)):
        if link.startswith("http"):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{page}: {link}"
        assert not anchor or anchor in anchors(target), f"{page}: {link}"


@every_page
def test_commands_can_be_typed(page):
    for words in commands_of(page):
        parse(words, whole=True)
    for words in mentions_of(page):
        if words[0] != "COMMAND":
            parse(words, whole=False)
    for wrong in ("calibate session", "calibrate session --neeed-mm 1", "simulate a --views many"):
        with pytest.raises(AssertionError, match=f"visioncal {wrong}"):
            parse(tuple(wrong.split()), whole=True)


@every_page
def test_names_on_a_page_exist(page):
    for name in spans_of(page):
        if re.fullmatch(r"visioncal(\.\w+)+", name):
            assert found(name), f"{page}: {name}"
        elif re.fullmatch(r"[\w/]+/\w+\.py", name):
            assert any((path / name).is_file() for path in (ROOT, ROOT / "visioncal")), (
                f"{page}: {name}"
            )
    for block in code_of(page):
        for name in re.findall(r"(?<!from )\bvisioncal\.([A-Za-z]\w+)\(", block):
            assert hasattr(visioncal, name), f"{page}: visioncal.{name}"
    for kind, name in re.findall(r"\b([A-Z][a-z]\w+)\.([a-z]\w+)", text_of(page)):
        if known := getattr(visioncal, kind, None) or getattr(dynamics, kind, None):
            assert name in dir(known) or name in known.__dataclass_fields__, (
                f"{page}: {kind}.{name}"
            )


def found(name: str) -> bool:
    """Whether a dotted name is a module, or something in one."""
    try:
        import_module(name)
    except ModuleNotFoundError:
        module, _, last = name.rpartition(".")
        return hasattr(import_module(module), last)
    return True


def test_every_command_and_option_is_on_a_page():
    text = "\n".join(map(text_of, PAGES))
    words = [command for page in PAGES for command in (*commands_of(page), *mentions_of(page))]
    named = {command_of(word)[2] for word in words if word[0] != "COMMAND"}
    for name, command in COMMANDS.items():
        assert name in named, f"no page has visioncal {name}"
        for param in command.params:
            flags = [*param.opts, *param.secondary_opts]
            assert flags == [param.name] or any(
                re.search(rf"(?<![\w-]){flag}(?![\w-])", text) for flag in flags
            ), f"no page has {flags} of visioncal {name}"


def test_every_field_of_a_result_is_on_its_page():
    words = set(re.findall(r"\w+", text_of(ROOT / "visioncal" / "results" / "README.md")))
    assert {field.name for field in fields(visioncal.Calibration)} <= words


@pytest.mark.parametrize("package", PACKAGES, ids=lambda path: path.name)
def test_a_table_of_modules_has_all_of_them(package):
    page = text_of(package / "README.md")
    if not re.search(r"^\| (module|package)\b", page, re.MULTILINE):
        return
    files = {
        path.stem
        for path in package.iterdir()
        if path.name[0] not in "_." and path.suffix in (".py", "")
    }
    named = {name.rpartition(".")[2] for name in spans_of(package / "README.md")}
    assert files <= named


def test_fields_of_a_result_have_the_order_of_its_file():
    table = text_of(ROOT / "visioncal" / "results" / "README.md").split("\n### ")[0]
    shown = [
        name
        for cell in re.findall(r"^\| (`.*?) \|", table, re.MULTILINE)
        for name in re.findall(r"`(\w+)`", cell)
    ]
    order = [
        key
        for form in (CalibrationForm, CalibrationSections)
        for entry in entries(form)
        for key in entry.keys
    ]
    # The plural of one row stands within it.
    assert shown == [key for key in order if key not in ("boards", "rigs")]


def test_every_kind_of_finding_is_on_a_page():
    assert {*SUSPECTS} <= set(spans_of(ROOT / "visioncal" / "calibration" / "README.md"))


def test_every_public_name_is_on_a_page():
    words = {word for page in PAGES for name in spans_of(page) for word in re.findall(r"\w+", name)}
    assert {*visioncal.__all__} - {"__version__"} <= words


def test_the_architecture_has_every_package():
    (order,) = [
        name for name in code_of(ROOT / "visioncal" / "README.md") if name.split()[0] == "core"
    ]
    assert sorted(order.split()) == [package.name for package in PACKAGES]


def test_the_front_page_s_session_is_calibrated(rendered, tmp_path):
    """Its session.toml and the columns of its views.csv, with a cell's pictures and poses."""
    blocks = BLOCK.findall(text_of(FRONT))
    (declared,) = [text for language, _, text in blocks if language == "toml"]
    (head,) = re.findall(r"^(view,image,.*)$", text_of(FRONT), re.MULTILINE)
    with (rendered / "views.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    (tmp_path / "session.toml").write_text(declared)
    (tmp_path / "images").mkdir()
    for path in (rendered / "images").iterdir():
        # The page's pictures have twice the width.
        large = cv2.resize(cv2.imread(str(path)), (1280, 800), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(tmp_path / "images" / path.name), large)
    with (tmp_path / "views.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, head.split(","), extrasaction="ignore")
        table.writeheader()
        table.writerows(rows)
    assert visioncal.calibrate(visioncal.Session.load(tmp_path)).verdict.status == "good"


def test_the_front_page_is_short():
    assert len(text_of(FRONT).splitlines()) <= 180


def test_the_front_page_and_those_around_it_show_what_recipes_print():
    """Recipes are run; see test_cookbook."""
    expected = [
        " ".join(text.split())
        for page in FOLDER.glob("*.md")
        for language, _, text in BLOCK.findall(text_of(page))
        if language == "expect"
    ]
    shown = [
        " ".join(text.split())
        for page in (FRONT, *AROUND)
        for language, _, text in BLOCK.findall(text_of(page))
        if language == "text"
    ]
    assert len(shown) >= 10
    for name in shown:
        assert any(name in text for text in expected), name
