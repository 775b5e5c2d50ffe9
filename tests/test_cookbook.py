"""Every recipe, and every example that needs no data, prints what its page shows."""

import json
import re
from pathlib import Path

import pytest
from support.recipes import FOLDER, match, run, run_example

PACKAGES = Path(__file__).parents[1] / "visioncal"
# Blocks of a package's page that begin with a simulation.
EXAMPLES = {
    page: found
    for page in sorted(PACKAGES.glob("*/README.md"))
    if (
        found := re.findall(
            r"^( {4}\$ visioncal simulate .*\n(?: {4,}\S.*\n)*)",
            page.read_text("utf-8"),
            re.MULTILINE,
        )
    )
}

PAGES = sorted(set(FOLDER.glob("*.md")) - {FOLDER / "README.md"})
QUICK = ("samples_of_easy_handeye", "weekly_check_by_cron")


# The quicker ones are run each time.
RUN = [pytest.param(path, marks=() if path.stem in QUICK else pytest.mark.slow) for path in PAGES]


@pytest.mark.parametrize("page", RUN, ids=lambda value: value.stem)
def test_a_recipe_prints_what_it_shows(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(page)


@pytest.mark.slow
@pytest.mark.parametrize("page", EXAMPLES, ids=lambda value: value.parent.name)
def test_an_example_prints_what_its_page_shows(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for block in EXAMPLES[page]:
        run_example(block, page.parent.name)
    documented = set(re.findall(r"\w+", (PACKAGES / "results" / "README.md").read_text("utf-8")))
    for path in tmp_path.glob("*/calibration.json"):
        assert json.loads(path.read_text("utf-8")).keys() <= documented


@pytest.mark.parametrize("page", PAGES, ids=lambda value: value.stem)
def test_a_recipe_is_a_page(page):
    assert len(page.read_text(encoding="utf-8").splitlines()) <= 60


def test_output_that_differs_from_a_page_is_noticed():
    said = "bad b\nview 4 is wrong, sigma 0.048 mm"
    match("view 4 is wrong, ... 0.049 mm", said, "a page")
    for expected in ("good b", "view 5 is wrong", "sigma 0.051 mm", "sigma 0.048 ... view 4"):
        with pytest.raises(AssertionError, match="is not in what was said"):
            match(expected, said, "a page")
