"""Findings and remedies carry their parts: none is read out of words or commands."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.cells import pairs_session
from test_undone import poses_of

from visioncal.calibration.pipeline.explaining import explained
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import STAGES, Stage, run_stages
from visioncal.calibration.stages.other_board import OtherBoardError
from visioncal.calibration.suspects.moved_views import without_tool
from visioncal.calibration.suspects.pairs_alone import PairAlone, found_alone, of_all_rows
from visioncal.cli.summary import _not_in_verdict
from visioncal.core.errors import DegenerateError
from visioncal.core.transforms import exp
from visioncal.core.types import MOUNTS
from visioncal.core.verdict import (
    AGAIN,
    Finding,
    Option,
    Remedy,
    Verdict,
    again,
    calibrating,
    mending,
    with_paths,
)
from visioncal.results import CONTRADICTS, ViewResult
from visioncal.simulation import NetworkOptions, cell_session, simulate
from visioncal.verification.misreading import misreading

# Sentences that end where others begin to say what follows from a cause.
_CAUSE = "The lens changed; its focus is another one. The result counts in pixels."


@pytest.mark.parametrize(
    ("parts", "do", "advice"),
    [
        (
            {"consequence": "The result counts it."},
            Remedy("Hold it; or go.", plain="Hold."),
            "Hold.",
        ),
        ({"rivals": ("the board grew",)}, Remedy("Hold it; then go."), "Hold it; then go."),
        ({}, Remedy("Hold it."), "Hold it."),
    ],
)
def test_a_cell_has_the_whole_cause_of_a_pair_and_no_consequence(parts, do, advice):
    found = Finding("focus", _CAUSE, do, probability=0.9, **parts)
    answer = SimpleNamespace(verdict=Verdict("check", (found,)))
    pair = SimpleNamespace(camera="cam_top", target="target")
    run = SimpleNamespace(
        session=SimpleNamespace(robots={"a": None}, cameras={"top": None, "side": None}),
        assessment_or_none=None,
    )
    (cause,) = found_alone(run, [PairAlone("a", pair, answer)])
    assert cause.in_words().words == f"cam_top: {_CAUSE[0].lower()}{_CAUSE[1:]}"
    assert cause.do == Remedy(advice)


def test_rows_of_a_whole_robot_are_shifted_by_the_option_whatever_the_words_are():
    session = cell_session(simulate(NetworkOptions(stops=8)), "cell", seen="corners")
    rows = [view for view in session.views if view.text.get("robot") == "a"]
    shown = tuple(view.number for view in rows if view.stop in (2, 4))
    words = "each has its own pose (not by --shift 1-2:9, nor by --positions 3:x,y,z)"
    do = mending(words, Option("shift", "-2", shown))
    found = Finding("shifted_rows", "Rows are apart.", do, shown)
    every = of_all_rows(found, RunState(session), "a")
    between = tuple(view.number for view in rows if 2 <= view.stop <= 4)
    assert len(between) > len(shown)
    assert every.words == do.words
    assert every.option == replace(do.option, views=between)
    assert f"FIXED {every.option} && " in every.command
    other = replace(do, option=Option("turned", "180,0,0", (3,)))
    assert of_all_rows(replace(found, do=other), RunState(session), "a") is other


def test_a_tool_is_that_of_the_views_to_all_digits():
    tool = exp(np.array([0.1, -0.2, 0.3, 1.23456789e-2, 0.0, 0.15]))
    do = without_tool(tool, [3, 4, 6], "look again.")
    assert do.option.tool is tool
    assert f"--without-tool 3-4,6:{do.option.value} " in do.command
    assert do.words.endswith("it is taken off their poses, and calibrate it. Else look again.")


def test_commands_of_many_robots_are_by_hand_by_their_options_alone():
    do = mending("joints give the poses", Option("by-joints"))
    assert not do.of_cell(2, 1).command
    assert do.of_cell(1, 2) is do
    # Such letters may be of a name.
    board = mending("it is larger", Option("board-scale", "a--by-joints:1.01"))
    assert board.of_cell(2, 1) is board
    lens = mending("the lens is estimated", Option("intrinsics", "estimate"))
    assert not lens.of_cell(1, 2).command


def test_an_error_is_explained_by_what_explains_it_not_by_its_message(monkeypatch):
    state, error = RunState(pairs_session(MOUNTS[0], *poses_of(MOUNTS[0]))), DegenerateError("Few.")
    assert explained(error, state, "solve", are_located=False) is None

    def fails(_: RunState) -> RunState:
        raise error

    said = {"alone": DegenerateError("Few.", next_step="Look."), "beside": None}
    monkeypatch.setattr("visioncal.calibration.run._explained_by_pairs", lambda *_: said["beside"])
    with pytest.raises(DegenerateError, match=r"^Few\.$"):
        run_stages(state, [Stage("solve", fails)])
    said["beside"] = DegenerateError("A pair shows it.")
    with pytest.raises(DegenerateError, match="A pair shows it"):
        run_stages(state, [Stage("solve", fails)])
    # A cause may say the same, with a step.
    monkeypatch.setattr("visioncal.calibration.run.explained", lambda *_, **__: said["alone"])
    with pytest.raises(DegenerateError, match=r"^Few\. Look\.$"):
        run_stages(state, [Stage("solve", fails)])


@pytest.mark.parametrize(
    ("do", "words", "command"),
    [
        (
            calibrating("Correct the row of the calibrated arm, and"),
            "Correct the row of the calibrated arm, and verify again.",
            "visioncal verify SESSION --against OUT",
        ),
        (
            mending("calibrated poses are read so", Option("shift", "2", (3, 4))),
            "Write a copy of the session in which calibrated poses are read so, and verify it.",
            "visioncal convert SESSION FIXED --shift 3-4:2 && visioncal verify FIXED --against OUT",
        ),
        (Remedy("Look at the calibrated arm."), "Look at the calibrated arm.", ""),
    ],
)
def test_stops_that_are_misread_are_verified_and_no_word_beside_it(monkeypatch, do, words, command):
    found = Finding("misread_poses", "They are misread.", do)
    monkeypatch.setattr("visioncal.verification.misreading.misread_poses", lambda _: iter([found]))
    assert misreading(None).do == Remedy(words, command)


def test_paths_are_no_part_of_an_options_value(tmp_path, monkeypatch):
    """A board may be called as a placeholder is."""
    monkeypatch.chdir(tmp_path)
    do = mending("it is larger", Option("board-scale", "NEW:1.01"))
    assert with_paths(do.command, "a", "out") == (
        "visioncal convert a a-fixed --board-scale NEW:1.01 && visioncal calibrate a-fixed -o out"
    )
    assert with_paths("Look (visioncal show OUT).", "a", "out") == "Look (visioncal show out)."


def test_an_option_of_the_typed_command_is_beside_it():
    do = again("State it.", Option("robot-form", "quaternion"))
    assert do.command == f"{AGAIN} --robot-form quaternion"
    assert str(do) == "State it."


def test_views_whose_one_reason_a_finding_states_are_not_listed_again():
    """A reason may be a part of another one."""
    views = [_left_out(3, "disagrees with the others by 2 mm"), _left_out(4, "disagrees")]
    words = "Views 3, 4 were left out. View 3 disagrees with the others by 2 mm."
    found = Finding("wrong_views", words, views=(3, 4), without_it="The rest agrees.")
    verdict = Verdict("check", (found,))
    assert [*_not_in_verdict(verdict, views)] == views
    alike = [_left_out(3, "disagrees"), _left_out(4, "disagrees")]
    assert not [*_not_in_verdict(verdict, alike)]


def test_a_view_contradicts_the_others_by_its_reason_alone():
    assert _left_out(3, f"{CONTRADICTS}the others: blurred").contradicts
    assert not _left_out(3, f"blurred, and {CONTRADICTS}the others").contradicts
    assert not ViewResult(3, used=True, reason=CONTRADICTS).contradicts


def _left_out(view: int, reason: str) -> ViewResult:
    return ViewResult(view, used=False, reason=reason)


def test_a_model_that_cannot_be_read_is_known_by_its_place_in_the_session():
    session = pairs_session(MOUNTS[0], *poses_of(MOUNTS[0]))
    other = session.with_content(document={**session.document, "robot": {"model": "kuka"}})
    (unread,) = other.unread_models
    assert unread in other.warnings
    found = {at.words: at.kind for at in run_stages(RunState(other), STAGES[:1]).warnings}
    assert found[unread] == "misread_joints"


def test_a_note_of_a_conversion_is_in_no_file_and_no_doubt():
    session = pairs_session(MOUNTS[0], *poses_of(MOUNTS[0]))
    session = session.with_content(document={**session.document, "nmae": "cell"})
    note = "Found by the poses: they fit as first read."
    noted = replace(session, warnings=(note, *session.warnings))
    found = {at.words: at for at in run_stages(RunState(noted), STAGES[:1]).warnings}
    assert found[note] == Finding("note", note)
    (misspelt,) = session.warnings
    assert found[misspelt].kind == "remark"
    assert found[misspelt].do.words == "In session.toml, correct or delete what this names."


def test_an_error_has_copies_with_other_parts():
    error = OtherBoardError.of(Finding("other_board", "It is another.", Remedy("Look.")))
    copied = error.but(culprits=["view 3"])
    assert copied.finding is error.finding
    assert str(copied) == "It is another. Look."
    assert copied.culprits == ("view 3",)
    assert not copied.but(next_step="").next_step
    assert copied.within("board").within("board").message == "board: It is another."
    assert copied.but("Another.").next_step == "Look."


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("J2 yields by two slopes.", "Robot a: J2 yields by two slopes."),
        ("UR10e was named.", "Robot a: UR10e was named."),
        ("The arm drifts.", "Robot a: the arm drifts."),
        ("A joint slipped.", "Robot a: a joint slipped."),
    ],
)
def test_names_keep_their_capitals_behind_the_name_of_a_robot(words, said):
    assert Finding("note", words).of("Robot a").words == said
    assert Finding("note", words).of("").words == words
