#!/usr/bin/env python
"""Contact sheets of what the simulated Franka's operators do: results/franka/<name>.png, one row an episode.

python scripts/franka_pictures.py
"""

from lerobot_latentsafe.experiments.franka_pictures import draw_sheets

if __name__ == "__main__":
    draw_sheets()
