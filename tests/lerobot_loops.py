"""Stand-ins for LeRobot's loops, by which a robot tells when an episode begins."""

from lerobot_latentsafe._compat import RECORDING

RECORD_LOOP, POLICY_LOOP = RECORDING


def looping(where, call, **variables):
    """Let something be called by a loop of this name and with these variables, as by LeRobot's."""
    module, function = where
    space = {"__name__": module}
    exec(f"def {function}(call, {', '.join(variables)}):\n    return call()", space)
    return space[function](call, **variables)


class Recorded:
    """A dataset that is being recorded, as far as loops tell."""

    def __init__(self, episode):
        self.num_episodes = episode
