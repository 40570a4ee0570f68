# make demo and make test do all set-up by themselves: Python 3.11 to 3.13 and make are enough.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed

.DEFAULT_GOAL := help
.PHONY: help install blender ray demo test lint bench clean

help:  ## show this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "  make %-8s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

install: $(STAMP)  ## make .venv and install mv3d with the tested versions

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' || \
		{ echo "mv3d needs Python 3.11, 3.12 or 3.13: make install PYTHON=python3.12"; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet -c constraints.txt -e . --group dev
	@touch $(STAMP)

blender: $(STAMP)  ## add Blender, for --engine blender and its tests (Python 3.11)
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[blender]'

ray: $(STAMP)  ## add Ray, for --workers ray and its tests
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[ray]'

demo: $(STAMP)  ## make a mesh of a coffee cup from one photo, and print where it is
	$(BIN)/mv3d generate $$($(BIN)/python -c 'from skimage import data; print(data.__path__[0])')/coffee.png -o out/demo/views
	$(BIN)/mv3d fit-sdf out/demo/views -o out/demo/cup.glb
	@echo "look at out/demo/views/sheet.png, and open out/demo/cup.glb in any 3D viewer"

lint: $(STAMP)  ## style, types and the import rule
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

test: lint  ## lint, then the whole test suite
	$(BIN)/python -m pytest -n 2 -q

bench: $(STAMP)  ## every figure of the README
	@for script in benchmarks/render_*.py benchmarks/normals_*.py benchmarks/hash_grid_*.py benchmarks/mesh_*.py \
		benchmarks/fit_*.py benchmarks/train_*.py benchmarks/diffusion_*.py benchmarks/generate_*.py benchmarks/nvs.py; do echo "## $$script"; $(BIN)/python $$script || exit 1; done

clean:  ## remove the environment and what was built
	rm -rf .venv out build dist .pytest_cache .ruff_cache
