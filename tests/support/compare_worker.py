"""Does what `compare.py` asks of one checkout: a line of JSON a job, and one of what came of it.

Run as `python -P` with the checkout on PYTHONPATH; it knows visioncal by its commands and by names
that its README gives.
"""

import contextlib
import io
import json
import resource
import runpy
import sys
import traceback
import warnings


def used_s():
    """Processor time of this process and its children [s]."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def command(argv):
    """Runs a command in this process: exit status, and what it wrote to stdout."""
    out, status, sys.argv = io.StringIO(), 0, ["visioncal", *argv]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
        try:
            runpy.run_module("visioncal", run_name="__main__")
        except SystemExit as end:
            status = int(end.code or 0)
    return {"status": status, "out": out.getvalue()}


def located(calibration, looks):
    """Places (3,) in the base and covariances of pixels, each on a plane of its own."""
    from scipy.spatial.transform import RigidTransform

    import visioncal

    known, found = visioncal.Calibration.load(calibration), []
    for look in looks:
        plane = visioncal.Plane.through(look["normal"], look["point"])
        pose = None if look["pose"] is None else RigidTransform.from_matrix(look["pose"])
        (place,) = visioncal.locate(known, look["px"], plane, pose)
        found.append([place.p_base.tolist(), place.covariance.tolist()])
    return {"status": 0, "out": found}


def arm(calibration, **at):
    """(m, 4, 4) poses of the calibrated arm."""
    import visioncal

    known = visioncal.Calibration.load(calibration)
    return {"status": 0, "out": known.base_from_flange(**at).as_matrix().tolist()}


def main():
    # A command has no input, and sets up the streams that it finds.
    requests, sys.stdin = sys.stdin, io.StringIO()
    answers, sys.stdout = sys.stdout, sys.stderr
    warnings.simplefilter("ignore")
    jobs = {"command": command, "located": located, "arm": arm}
    if "--core" in sys.argv:
        from support import core_worker

        jobs |= {name: getattr(core_worker, name) for name in jobs}
    for line in requests:
        job, begun = json.loads(line), used_s()
        try:
            done = jobs[job.pop("do")](**job)
        except BaseException:  # noqa: BLE001 - a bug of the checkout's is an outcome, too
            done = {"status": 1, "out": traceback.format_exc()}
        answers.write(json.dumps(done | {"seconds": used_s() - begun}) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
