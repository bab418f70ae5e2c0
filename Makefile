# Two commands do everything on a fresh machine, set-up included: `make demo` and `make test`.
.PHONY: setup demo demo-bag test lint results

PYTHON = .venv/bin/python

setup:
	@scripts/setup.sh

demo: setup
	$(PYTHON) scripts/demo.py

# make demo-bag POLICY=<filter> BASE=<policy to be shielded>
demo-bag: setup
	MUJOCO_GL=$${MUJOCO_GL:-egl} $(PYTHON) scripts/demo_bag.py --policy="$(POLICY)" --base="$(BASE)"

test: lint
	HF_HUB_OFFLINE=1 $(PYTHON) -m pytest

lint: setup
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .

results: setup
	scripts/reproduce_dubins.sh
