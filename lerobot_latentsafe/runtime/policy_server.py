"""LeRobot's asynchronous policy server has a list of the types it serves, and asks no plugin."""


def serve_types(types: list[str]) -> None:
    """Have LeRobot's asynchronous policy server of this process accept policies of further types.

    Where its packages are not installed (`pip install 'lerobot[async]'`) there is no server, and nothing to do.
    """
    try:
        from lerobot.async_inference.constants import SUPPORTED_POLICIES
    except ImportError:
        return
    SUPPORTED_POLICIES.extend(name for name in types if name not in SUPPORTED_POLICIES)
