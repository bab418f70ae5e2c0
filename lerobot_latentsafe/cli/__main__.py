"""`python -m lerobot_latentsafe.cli`, where the console command is not on the path."""

from lerobot_latentsafe.cli import main

main()
