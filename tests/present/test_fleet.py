"""The page of a fleet and its years: what there is to say is in the first rows."""

import pytest
from support import browser
from support.marks import slow
from support.pages import Page
from support.site import NOW, STORIES, entries

from visioncal.present.report.fleet import page_of_history


@pytest.mark.parametrize("seed", [0, slow(2)])
def test_five_stories_are_the_first_five_rows(seed, tmp_path):
    text = page_of_history(entries(seed), "Site", NOW)
    page = Page(text)
    # A page of one file: its links lead to its own sections.
    assert all(link.startswith(("#", "data:")) for link in page.references if link)
    assert len(page.rows) == 1 + 12
    said = {}
    for row in page.rows[1:6]:
        words = " ".join(row.split())
        (story,) = (name for name in STORIES if words.startswith(name))
        said[story] = words
    assert list(said) == ["turned bad", "creeping jig", "knocked", "new print", "not verified"]
    assert "The board is bent by 1.2 mm. It was good on" in said["turned bad"]
    # Stepped between days 420 and 480, of which the first is 735 days ago.
    assert "flange_from_cam stepped by 0." in said["knocked"]
    assert "between 15 Jan 2026 and 16 Mar 2026 (over 99 %)" in said["knocked"]
    assert "base_from_jig creeps by 0." in said["creeping jig"]
    assert "the need of 0.5 mm will be missed in" in said["creeping jig"]
    assert "The sigma of flange_from_cam rose from 0.087 to 0.17 mm" in said["new print"]
    assert "Nothing has checked it since" in said["not verified"]
    # Nothing is said of a board that was put elsewhere.
    assert "base_from_target" not in page.words
    assert text.count("<figure") == 12
    if browser.CHROMIUM is not None and seed == 2:
        file = tmp_path / "page.html"
        file.write_text(text)
        browser.picture(file, 800, 1600, tmp_path / "page.png")
        assert (tmp_path / "page.png").stat().st_size > 50_000
