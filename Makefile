# Each target sets up what it needs in .venv, beside this file. Nothing is installed anywhere else, but that
# `bench-peers` asks apt-get for PCL where it may, and what runs Open3D for the system libraries of that.
# Stamp files in .venv/stamps remember what was done, so that a second run is quick.

.DEFAULT_GOAL := help
.NOTPARALLEL:
.DELETE_ON_ERROR:
SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c

PYTHON ?= python3
VENV := .venv
STAMPS := $(VENV)/stamps
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
# What the extension module is built from. The Python package is installed editable and needs no rebuild.
SOURCES := Cargo.toml Cargo.lock pyproject.toml \
	$(shell find crates/ibi-core crates/ibi-py -name '*.rs' -path '*/src/*' -o -name Cargo.toml)

# Where rustup puts cargo, for shells that have not read its profile yet.
export PATH := $(PATH):$(HOME)/.cargo/bin
# maturin installs into this environment, whichever one the caller has activated.
export VIRTUAL_ENV := $(CURDIR)/$(VENV)
unexport CONDA_PREFIX PYTHONHOME

.PHONY: help
help: ## list the targets
	@awk -F':.*## ' '/^[a-z-]+:.*## / { printf "  make %-12s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

.PHONY: demo
demo: $(STAMPS)/package $(STAMPS)/group-demo ## register the example scenes and draw what was found
	$(BIN)/python examples/demo.py

# Built whole: what an incremental build keeps for the next one takes longer to write than it saves here.
RUST_TESTS := CARGO_INCREMENTAL=0 cargo test --workspace --exclude ibi-py --exclude ibi-bench --all-features

.PHONY: test
test: cargo $(STAMPS)/package $(STAMPS)/group-test ## run the tests of Rust and Python
	$(RUST_TESTS)
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4

.PHONY: test-all
test-all: cargo $(STAMPS)/package $(STAMPS)/open3d $(STAMPS)/chromium $(STAMPS)/group-all ## the same with all that is optional, none skipped (installs Open3D, Dask, Ray, Rerun, Chromium)
	$(RUST_TESTS)
	$(BIN)/python -m pytest --none-skipped \
		$$(command -v chromium chromium-browser google-chrome >/dev/null || echo --ignore=tests/test_html.py)

.PHONY: test-clusters
test-clusters: $(STAMPS)/package $(STAMPS)/group-clusters ## run batches on a local cluster of Dask and of Ray (installs them)
	$(BIN)/python -m pytest tests/test_clusters.py

.PHONY: test-viz
test-viz: $(STAMPS)/package $(STAMPS)/group-viz ## read recordings of Rerun back (installs it)
	$(BIN)/python -m pytest tests/test_viz.py

FUZZ_S ?= 60
FUZZ_TARGETS := register features metrics params

.PHONY: fuzz
fuzz: cargo $(STAMPS)/package $(STAMPS)/group-test ## throw odd inputs at all that takes any, FUZZ_S=60 seconds at each (installs cargo-fuzz)
	@cargo fuzz --version >/dev/null 2>&1 || cargo install --quiet --locked cargo-fuzz
	@mkdir -p $(addprefix fuzz/corpus/,$(FUZZ_TARGETS))
	cd fuzz && for target in $(FUZZ_TARGETS); do \
		cargo fuzz run --sanitizer none $$target corpus/$$target seeds/$$target -- \
			-max_total_time=$(FUZZ_S) -timeout=60 -rss_limit_mb=2048 -print_final_stats=1 -verbosity=0; done
	IBI_FUZZ_EXAMPLES=$$((2 * $(FUZZ_S))) $(BIN)/python -m pytest tests/test_fuzz.py

.PHONY: bench
bench: cargo ## time stages, kernels and whole runs with criterion; ARGS=gsac picks some
	cargo bench -p ibi-bench --bench '*' -- $(ARGS)

# Two threads of BLAS that wait for each other on a busy machine took seven times as long as one.
PAPER_TABLES := OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/paper_tables.py

.PHONY: tables
tables: $(STAMPS)/package $(STAMPS)/open3d peers pcl ## print the benchmark tables, write benchmarks/records and docs/figures (needs Open3D)
	$(BIN)/python benchmarks/symmetry.py examples/models
	$(BIN)/python benchmarks/near_copies.py examples/models
	$(BIN)/python benchmarks/accuracy.py
	$(BIN)/python benchmarks/ablation.py
	$(BIN)/python benchmarks/calibration.py
	$(PAPER_TABLES) --docs

.PHONY: paper-tables
paper-tables: $(STAMPS)/package $(STAMPS)/open3d peers pcl ## the last of these alone, the paper's tables; ARGS=--help tells more
	$(PAPER_TABLES) $(ARGS)

.PHONY: bench-peers
bench-peers: $(STAMPS)/package $(STAMPS)/open3d peers pcl ## compare with PCL, Open3D, KISS-Matcher, OpenCV, ECC; ARGS=--help tells more
	$(BIN)/python benchmarks/compare.py $(ARGS)

.PHONY: bench-detect
bench-detect: $(STAMPS)/package $(STAMPS)/group-test ## from mesh and scan to poses on the real scans; ARGS=--docs records
	$(BIN)/python benchmarks/detect.py $(ARGS)

.PHONY: bench-piles
bench-piles: $(STAMPS)/package $(STAMPS)/group-test $(STAMPS)/open3d peers pcl ## detect in ray-cast piles, beside PCL and OpenCV; ARGS=--docs records (needs Open3D)
	$(BIN)/python benchmarks/piles.py $(ARGS)

.PHONY: bench-verdict
bench-verdict: $(STAMPS)/package $(STAMPS)/open3d ## whether scores are true in bins, rows, rooms, on real scans; ARGS=--quick, --docs records (needs Open3D)
	$(BIN)/python benchmarks/verdict.py $(ARGS)

.PHONY: bench-bins
bench-bins: $(STAMPS)/package $(STAMPS)/open3d ## several kinds of parts alone and together, in bins and on real boxes; ARGS=--quick, --docs records (needs Open3D)
	$(BIN)/python benchmarks/bins.py $(ARGS)

.PHONY: bench-covariance
bench-covariance: $(STAMPS)/package $(STAMPS)/open3d ## whether poses are as far off as they say, in bins and alone; ARGS=--detect (needs Open3D)
	$(BIN)/python benchmarks/covariance.py $(ARGS)

.PHONY: bench-speed
bench-speed: $(STAMPS)/package $(STAMPS)/open3d ## time whole calls from Python and their growth, write records and a picture (needs Open3D)
	$(BIN)/python benchmarks/speed.py

.PHONY: bench-limits
bench-limits: $(STAMPS)/package ## time against size on the worst inputs, and how late a limit ends them; ARGS=--docs records
	$(BIN)/python benchmarks/limits.py $(ARGS)

.PHONY: bench-features
bench-features: $(STAMPS)/package $(STAMPS)/open3d ## time the built-in features against Open3D, write the record (needs Open3D)
	$(BIN)/python benchmarks/features.py

.PHONY: lint
lint: cargo $(STAMPS)/package $(STAMPS)/group-lint $(STAMPS)/group-test ## check formatting, lints, types, stubs and Rust docs
	cargo fmt --all --check
	cargo clippy --workspace --all-targets --all-features -- -D warnings
	cargo check -p ibi-core --tests --no-default-features
	RUSTDOCFLAGS="-D warnings" cargo doc -p ibi-core --no-deps --all-features
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m mypy.stubtest ibi_rs._core

.PHONY: docs
docs: $(STAMPS)/package $(STAMPS)/group-docs ## build the documentation into docs/_build
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build
	@echo "open docs/_build/index.html"

.PHONY: gallery
gallery: $(STAMPS)/package $(STAMPS)/group-cli ## run examples/gallery and draw the pictures of docs/gallery.md
	for scene in examples/gallery/*.py; do $(BIN)/python $$scene; done

.PHONY: wheel
wheel: cargo $(STAMPS)/venv ## build a wheel into dist
	$(BIN)/maturin build --release --out dist

.PHONY: clean
clean: ## remove all that make has made
	rm -rf $(VENV) target dist docs/_build .pytest_cache .mypy_cache .ruff_cache
	rm -f python/ibi_rs/_core*.so python/ibi_rs/_core*.pyd benchmarks/peers/_pcl.so
	find python tests benchmarks examples docs -name __pycache__ -type d -prune -exec rm -rf {} +

# What the targets need ------------------------------------------------------------------------------------

.PHONY: cargo
cargo:
	@command -v cargo >/dev/null || { echo "make: cargo is missing; install Rust 1.89 or newer (https://rustup.rs)" >&2; exit 1; }

$(STAMPS)/venv:
	@command -v "$(PYTHON)" >/dev/null || { \
		echo "make: $(PYTHON) is missing; install Python 3.10 or newer, or name one: make PYTHON=python3.12" >&2; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { \
		echo "make: $(PYTHON) is $$("$(PYTHON)" -V), and 3.10 or newer is needed; name one: make PYTHON=python3.12" >&2; exit 1; }
	@"$(PYTHON)" -c 'import ensurepip, venv' 2>/dev/null || { \
		echo "make: $(PYTHON) cannot make environments; on Debian and Ubuntu: apt-get install python3-venv" >&2; exit 1; }
	"$(PYTHON)" -m venv $(VENV)
	$(PIP) --upgrade "pip>=25.1" "maturin>=1.9,<2"
	@mkdir -p $(STAMPS) && touch $@

# The package, in release, editable.
$(STAMPS)/package: $(STAMPS)/venv $(SOURCES) | cargo
	$(BIN)/maturin develop --release
	@touch $@

# One of the [dependency-groups] of pyproject.toml.
$(STAMPS)/group-%: $(STAMPS)/venv pyproject.toml
	$(PIP) --group $*
	@touch $@

$(STAMPS)/open3d: $(STAMPS)/group-bench
	@$(BIN)/python -c 'import open3d' 2>/dev/null || if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		echo "make: installing what Open3D needs with apt-get"; apt-get update -qq || true; \
		DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends \
			libusb-1.0-0 libgl1 libgomp1 >/dev/null || true; fi
	@$(BIN)/python -c 'import open3d' || { \
		echo "make: Open3D cannot be loaded; on Debian and Ubuntu: apt-get install libusb-1.0-0 libgl1 libgomp1" >&2; exit 1; }
	@touch $@

# The browser that pages are tested in: the system's, as Playwright's own is no package.
$(STAMPS)/chromium: $(STAMPS)/venv
	@command -v chromium chromium-browser google-chrome >/dev/null || { \
		if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		echo "make: installing Chromium with apt-get"; apt-get update -qq || true; \
		DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends chromium >/dev/null || true; fi; }
	@command -v chromium chromium-browser google-chrome >/dev/null || \
		echo "make: Chromium is missing, so no page is opened; on Debian: apt-get install chromium" >&2
	@touch $@

# A peer that cannot be had is a row of the comparison that says so, and not the end of it.
.PHONY: peers
peers: $(STAMPS)/venv
	@$(MAKE) --no-print-directory $(STAMPS)/group-peers || \
		for peer in kiss-matcher opencv-contrib-python-headless; do \
			$(PIP) $$peer || echo "make: $$peer cannot be installed; going on without it" >&2; done

# The driver of PCL; benchmarks/peers/pcl.cpp tells why these flags.
PCL_DRIVER := benchmarks/peers/_pcl.so
PCL_FLAGS := -std=c++17 -O3 -march=native -DEIGEN_MAX_ALIGN_BYTES=16 -DPCL_NO_PRECOMPILE -DNDEBUG -w

.PHONY: pcl
pcl:
	@pkg-config --exists pcl_recognition 2>/dev/null || if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		echo "make: installing PCL and what it depends on with apt-get"; apt-get update -qq || true; \
		DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends \
			g++ pkg-config libpcl-dev >/dev/null || true; fi
	@{ command -v $(CXX) && pkg-config --exists pcl_recognition; } >/dev/null 2>&1 || { \
		echo "make: going on without PCL; it needs g++, pkg-config and, on Debian and Ubuntu, apt-get install libpcl-dev" >&2; \
		exit 0; }; $(MAKE) --no-print-directory $(PCL_DRIVER) || echo "make: going on without PCL" >&2

$(PCL_DRIVER): benchmarks/peers/pcl.cpp benchmarks/peers/pcl.map
	$(CXX) $(PCL_FLAGS) $$(pkg-config --cflags pcl_recognition) -fPIC -shared -Wl,--no-undefined \
		-Wl,--version-script=benchmarks/peers/pcl.map $< -o $@ -lpcl_recognition -lpcl_common -llz4
