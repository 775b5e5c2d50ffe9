"""Whether a calibration.json is as the shipped JSON Schema says, for tests."""

import json
from functools import cache
from pathlib import Path

from jsonschema import Draft202012Validator

import visioncal.results
from visioncal.core.errors import VisioncalError
from visioncal.results import Calibration

SHIPPED = Path(visioncal.results.__file__).with_name("calibration.schema.json")


@cache
def _validator() -> Draft202012Validator:
    return Draft202012Validator(json.loads(SHIPPED.read_text()))


def faults(document: object) -> list[str]:
    """What is wrong with a document, each with its place."""
    return [
        f"{error.json_path}: {error.message[:200]}" for error in _validator().iter_errors(document)
    ]


def faults_below(folder: Path) -> list[str]:
    """What is wrong with the calibrations below a folder; of those with the same keys, with one.

    Files that are refused when they are read were damaged by their tests.
    """
    seen, found = set(), []
    for path in sorted(folder.rglob("calibration.json")):
        try:
            document = json.loads(path.read_bytes())
            keys = frozenset(document)
            if keys not in seen:
                Calibration.from_json(json.dumps(document), str(path))
                seen.add(keys)
                found += [f"{path}: {fault}" for fault in faults(document)]
        except (VisioncalError, OSError, ValueError, TypeError):
            continue
    return found
