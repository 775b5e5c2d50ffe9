"""`visioncal dynamics validate`."""

from visioncal.cli.dynamics import AgainstOption, MotionsArgument, StreamOptions
from visioncal.cli.options import AsJson


def dynamics_validate_command(
    session: MotionsArgument,
    streams: StreamOptions,
    against: AgainstOption = None,
    as_json: AsJson = False,
) -> None:
    """Predict the torques of other motions, and say how near that comes.

    Exit status 0: there are figures; 2: there are none, for the reason given.
    """
    # Imported late, so that --help stays fast.
    from visioncal.cli.identified_dynamics import print_predictions

    print_predictions(session, streams, against, as_json=as_json)
