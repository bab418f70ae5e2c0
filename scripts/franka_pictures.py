#!/usr/bin/env python
"""Contact sheets of what the simulated Franka's operators do: results/franka/<name>.png, one row an episode.

scripts/franka_pictures.py
"""

import argparse

from lerobot_latentsafe.experiments.franka_pictures import draw_sheets

if __name__ == "__main__":
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()  # --help, or a wrong option, draws nothing
    draw_sheets()
