"""LeRobot devices that need no calibration, robots and operators alike."""


class Uncalibrated:
    """Calibrated already, and configured on connect. Name it before LeRobot's base class."""

    @property
    def is_calibrated(self) -> bool:
        """Always: an arm is calibrated at the factory, a simulation and a script need none."""
        return True

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do: what there is to configure is configured on connect."""
