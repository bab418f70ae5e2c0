# Two commands do everything on a fresh machine, set-up included: `make demo` and `make test`.
.PHONY: setup demo demo-bag test lint results

PYTHON = .venv/bin/python
# Tests and commands start many processes: without kept bytecode each would compile all that it imports.
unexport PYTHONDONTWRITEBYTECODE

setup:
	@scripts/setup.sh

demo: setup
	$(PYTHON) scripts/demo.py

# The committed filter of the bag, or another, and the policy to be shielded, or none (BASE=):
# make demo-bag POLICY=<filter> BASE=<policy>
POLICY ?= bag
BASE ?= bag_diffusion_weak
demo-bag: setup
	MUJOCO_GL=$${MUJOCO_GL:-egl} $(PYTHON) scripts/demo_bag.py --policy="$(POLICY)" $(if $(BASE),--base="$(BASE)")

test: lint
	HF_HUB_OFFLINE=1 $(PYTHON) -m pytest

lint: setup
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .

results: setup
	scripts/reproduce_dubins.sh
