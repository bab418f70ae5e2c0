"""The verb that labels on a page. What it is given is refused before LeRobot, which takes seconds, is loaded."""

import getpass
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

from lerobot_latentsafe.cli.command_line import with_lerobot
from lerobot_latentsafe.cli.places import DatasetPlace, OptionalPolicySource
from lerobot_latentsafe.datasets.layout import check_layout
from lerobot_latentsafe.labeling.listening import listen


@dataclass
class Label:
    """Open a local page on which a person marks where episodes fail; every key is saved beside the dataset.

    latentsafe label --dataset.repo_id=me/bag --dataset.root=data/bag

    With --policy.path, a trained filter draws its margin, guesses, and puts the most useful episodes first.
    """

    dataset: DatasetPlace = field(default_factory=DatasetPlace)
    policy: OptionalPolicySource = field(default_factory=OptionalPolicySource)
    specifications: list[str] = field(default_factory=lambda: ["failure"])
    """What can fail: each name gets labels of its own; those that have a label file are offered anyway."""
    user: str | None = None
    """Who labels; kept with each label. By default who is logged in."""
    host: str = "127.0.0.1"
    """The address to listen at."""
    port: int = 8765
    """0 takes a free one."""

    def run(self) -> None:
        """Serve the page until interrupted."""
        if not (find_spec("starlette") and find_spec("uvicorn")):
            raise ImportError("the page needs starlette and uvicorn: pip install 'lerobot_policy_latentsafe[label]'")
        self.dataset.require_whole("the page", "leave it out: the page shows all episodes, and unlabelled ones first")
        if self.dataset.root:
            check_layout(Path(self.dataset.root))
        with listen(self.host, self.port) as listener:
            with_lerobot()
            from lerobot_latentsafe.cli.open_page import open_page  # loads LeRobot

            open_page(self.dataset, self.policy.path, self.specifications, self.user or getpass.getuser(), listener)
