"""The labelling page of a dataset, once nothing that was typed is to be refused any more."""

import socket

from lerobot_latentsafe.cli.options import DatasetSource
from lerobot_latentsafe.cli.places import DatasetPlace
from lerobot_latentsafe.labeling.app import LabelServer, serve
from lerobot_latentsafe.labeling.store import LabelStore
from lerobot_latentsafe.labeling.suggestions import Suggester


def open_page(
    dataset: DatasetPlace, policy: str | None, specifications: list[str], user: str, listener: socket.socket
) -> None:
    """Serve the page until interrupted.

    Args:
        policy: a trained filter that guesses; None: nobody does.
        specifications: names of what can fail.
        user: who labels.
        listener: bound where the page is to be.
    """
    frames = DatasetSource(**vars(dataset)).frames()
    store = LabelStore(frames.root, frames.meta.repo_id, specifications)
    server = LabelServer(store, frames, user)
    if policy:
        server.suggester = Suggester(policy, frames.meta.repo_id, frames.root, server.suggestion_arrived)
    serve(server, listener)
