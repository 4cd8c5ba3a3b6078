# Everything from a bare checkout with Python 3.11 or 3.12: `make test`. See `make help`.

PYTHON ?=
export PYTHON

# Other versions of the dependencies: jazzy, minimum, newest or kilted (tools/make_venv.sh), each in folders of its own.
ENVIRONMENT ?=
SUFFIX := $(if $(ENVIRONMENT),-$(ENVIRONMENT))
INSTALL := install$(SUFFIX)
# where tests, demo and benchmarks find the installed programs
export SLPI_INSTALL := $(INSTALL)
ifneq ($(ENVIRONMENT),)
# Numba keeps its machine code beside the sources, for one version of Numba at a time.
export NUMBA_CACHE_DIR := $(CURDIR)/.venv$(SUFFIX)/numba_cache
endif

VENV   := .venv$(SUFFIX)/bin/python
# hundreds of processes are started: each would compile the sources anew without the files that Python keeps of them
COMPILED := env -u PYTHONDONTWRITEBYTECODE
COLCON := $(COMPILED) $(VENV) -c 'import sys; from colcon_core.command import main; sys.exit(main())'
# every command that starts nodes needs the workspace in its environment
IN_WORKSPACE := . $(INSTALL)/setup.sh &&
# what drives simulated stages keeps away from the ROS domain of a real one
IN_OWN_DOMAIN := $(IN_WORKSPACE) $(VENV) benchmarks/ros_domain.py

VENV_STAMP  := .venv$(SUFFIX)/.stamp
BUILD_STAMP := $(INSTALL)/.stamp

# Two workers wait for nodes most of the time, the others compute (test/conftest.py).
PYTEST := $(IN_WORKSPACE) $(COMPILED) $(VENV) -m pytest -n 4

# What .venv has to be made for: a copied checkout, another Python or a newly sourced ROS needs another one.
WANTED := $(CURDIR) ROS_DISTRO=$(ROS_DISTRO) $(if $(PYTHON),PYTHON=$(PYTHON))
ifneq ($(filter newest kilted,$(ENVIRONMENT)),)
# the newest of today
$(VENV_STAMP): FORCE
endif
ifneq ($(filter-out $(shell cat $(VENV_STAMP) 2>/dev/null),$(WANTED)),)
$(VENV_STAMP): FORCE
endif

# Modules need no rebuild: --symlink-install makes the source tree and the installed package one.
INSTALLED := package.xml setup.py setup.cfg $(wildcard config config/* launch launch/* msg_schemas msg_schemas/* resource/*)

.PHONY: help build test test-long test-properties test-jazzy test-newest test-kilted test-minimum test-environment demo bench bench-robustness bench-latency bench-platforms bench-soak bench-trajectory bench-readme bench-faults bench-steps audit docs schemas package bench-lies bench-calibrator bench-promise bench-fleet clean distclean bench-restarts bench-rate-law bench-foreign bench-no-harm bench-measured bench-twins bench-agreement bench-confusion bench-driver bench-device-faults bench-device-lives bench-surroundings bench-learning bench-loop-rate bench-oscillation bench-tune bench-export bench-coverage bench-identification bench-diagnosis-speed test-export-arm bench-company FORCE

help:
	@echo 'make build      .venv with pinned dependencies (or on top of a sourced ROS 2 Jazzy), then colcon build'
	@echo 'make test       build, lint, types, docstrings, tests: a quarter of an hour on two cores'
	@echo 'make test-long  build, then the tests that take long'
	@echo 'make test-properties  build, then all properties, with four times the examples of make test'
	@echo 'make test-jazzy    the versions of Ubuntu 24.04 with Python 3.12: the quick tests of make test that depend on them'
	@echo 'make test-newest   the same tests with the newest versions of today, Python 3.13 if it is there; make test-minimum with'
	@echo '                   the oldest allowed; make test-kilted with the newest and ROS 2 Kilted'
	@echo 'make docs       build, then the documentation site: docs/_build/html/index.html'
	@echo 'make schemas    what the schemas say of effects, anew from the effects'
	@echo 'make package    source distribution and wheel, installed and tried in a fresh environment without ROS'
	@echo 'make demo       build, then a simulated stage is calibrated and follows a path; SEED= repeats one'
	@echo 'make bench      build, then the benchmarks; ratios that have grown by more than 20 % are marked'
	@echo 'make bench-identification  time, memory and results of identifications beside another commit; BESIDE=built clone'
	@echo 'make bench-diagnosis-speed  time and memory of diagnoses beside another commit, 5 minutes; BESIDE=built clone'
	@echo 'make bench-robustness  spoiled records beside clean ones, 8 seeds, 2 minutes'
	@echo 'make bench-latency  round trip through the compensator beside a bare echo node, 4 minutes'
	@echo 'make bench-driver    cycles of the driver with simulated devices: rate, lateness, processor, two minutes'
	@echo 'make bench-device-faults  faults of simulated devices: what moves, how long a call waits, when it is told, 4 minutes'
	@echo 'make bench-device-lives   calibration, scan and verification through every driver and without one, 24 minutes'
	@echo 'make bench-surroundings  hidden temperature and load: right topic, gain, decoys, a later day; half an hour'
	@echo 'make bench-platforms  RECORD=table.csv: the ten commands with the versions of Ubuntu 24.04, the newest, and those beside'
	@echo '                   Kilted: the same figures? PLATFORMS="jazzy" chooses some of them'
	@echo 'make bench-restarts   a compensator that is killed and started again: time to its first answer, 10 minutes; RESTARTS="--beside PYTHON"'
	@echo 'make bench-company    200 lives of nodes beside each other: voltages from what must not move, refusals; half an hour; COMPANY="--lives 60"'
	@echo 'make bench-soak     10 minutes at 1 kHz, 1 minute at 5 kHz, and the ceiling'
	@echo 'make bench-trajectory  a trajectory of a million points: acceptance and deadlines'
	@echo 'make bench-readme   the commands of README on five simulated stages, and on the next day, 10 minutes'
	@echo 'make bench-steps    largest step, slew and acceleration that leave a compensator, 10,000 episodes and 100 lives; 40 minutes'
	@echo 'make bench-faults   mutated files, node lives under faults, half an hour at 1 kHz, a day at accelerated time; 90 minutes'
	@echo 'make audit      known vulnerabilities of the pinned dependencies, by pip-audit'
	@echo 'make bench-learning  paths that repeat on stages of other physics, beside feedback and another learning; 20 minutes; LEARNING="--count 40 --all-paths"'
	@echo 'make bench-loop-rate  crossover of the closed loop with 10, 100 and 1,000 commands a second, two minutes'
	@echo 'make bench-tune     30 stages identified and tuned automatically: bandwidth, margin, detuned modes, a raster; half an hour'
	@echo 'make bench-oscillation  feedback that oscillates and feedback that is well tuned: what is switched off, and when; six minutes'
	@echo 'make bench-lies     eight kinds of faulty sensors, and sound ones: time driven, false alarms; ten minutes'
	@echo 'make bench-rate-law  the rate law: round trips, cost, and what it predicts of measured records, 15 minutes'
	@echo 'make bench-foreign   stages whose physics is not that of the package: PI, SLPI, SLPI with causes; 15 minutes'
	@echo 'make bench-no-harm   the same on measured records that were not fitted, of other actuators too; 15 minutes'
	@echo 'make bench-measured   every measured record, thirteen methods: table, picture, README; 45 minutes'
	@echo 'make bench-twins       the methods of bench-measured beside second implementations; half an hour'
	@echo 'make bench-agreement  200 hostile bags: command line, identify node and fleet decide the same; 3 minutes'
	@echo 'make bench-confusion   effects, pairs, clean stages and causes that no effect describes: wrong or silent; an hour'
	@echo 'make bench-calibrator  calibrations over DDS that meet a fault: limits, rest at the end, what is kept; 20 minutes'
	@echo 'make bench-promise     the error that the calibrator promises on 20 stages, and that of scans later; half an hour'
	@echo 'make bench-coverage   true errors within two standard uncertainties, and how large these are, by horizon; COVERAGE="--stages 100"; 20 minutes'
	@echo 'make bench-fleet    300 bags of 30 stages on Dask: changes found, one worker beside two, 20 minutes'
	@echo 'make bench-export   the exported C inverse beside the stream of Python: agreement, time, memory; a few minutes'
	@echo 'make test-export-arm  the exported C inverse on simulated Cortex-M4F and M7; as root it installs the tools (apt, 1 GB)'
	@echo 'make clean      remove what was built and all caches'
	@echo 'make distclean  the same, and the environments'
	@echo 'PYTHON=/path/to/python3.12 chooses the Python; 3.11 and 3.12 work'

build: $(BUILD_STAMP)

$(VENV_STAMP): setup.py tools/make_venv.sh tools/find_python.sh $(wildcard requirements/*.txt)
	@tools/make_venv.sh $(ENVIRONMENT)
	@echo '$(WANTED)' >$@

$(BUILD_STAMP): $(VENV_STAMP) $(INSTALLED)
	@rm -rf build$(SUFFIX) $(INSTALL)
	@$(COLCON) --log-base log$(SUFFIX) build --build-base build$(SUFFIX) --install-base $(INSTALL) --symlink-install \
		--event-handlers console_start_end- summary-
	@touch $@
	@echo 'slpi_ros: built; each terminal needs: source $(INSTALL)/setup.bash; export PATH="$$PWD/.venv$(SUFFIX)/bin:$$PATH"'

# The types are checked beside the tests, of which those with nodes wait most of their time.
test: build
	$(VENV) -m ruff check .
	$(VENV) -m ruff format --check .
	@$(VENV) -m mypy & types=$$!; ($(PYTEST) -m 'not long'); tests=$$?; wait $$types && exit $$tests

test-long: build
	$(PYTEST) -m long

test-properties: export SLPI_EXAMPLES = 100
test-properties: build
	$(PYTEST) -m hypothesis

# The tests of `make test` that take no more than ten seconds and whose outcome may depend on versions: not those of the
# checkout itself, and one case of each.
test-jazzy test-newest test-kilted test-minimum:
	@$(MAKE) --no-print-directory ENVIRONMENT=$(@:test-%=%) test-environment

test-environment: export SLPI_EXAMPLES = 10
test-environment: export SLPI_FIRST_CASES = 1
test-environment: build
	$(VENV) tools/list_versions.py
	$(PYTEST) -m 'not long and not slow' $(addprefix --ignore=test/,benchmarks documentation test_architecture.py)

schemas: build
	$(VENV) tools/make_schemas.py

docs: build
	$(VENV) -m sphinx -E -W --keep-going -q docs docs/_build/html

package: $(VENV_STAMP)
	$(VENV) tools/check_package.py --install

demo: build
	$(IN_OWN_DOMAIN) $(VENV) demo/run_demo.py $(if $(SEED),--seed $(SEED))

bench: build
	$(IN_OWN_DOMAIN) $(VENV) benchmarks/run_all.py

bench-identification: build
	$(VENV) benchmarks/identification_speed.py --measured $(if $(BESIDE),--beside $(BESIDE))

bench-diagnosis-speed: build
	$(VENV) benchmarks/diagnosis_speed.py --beside $(BESIDE)

bench-robustness: build
	$(VENV) benchmarks/robustness.py

# All environments on one record, say RECORD=afm_double_sine_x.csv
PLATFORMS := jazzy newest kilted
bench-platforms: build
	@for each in $(PLATFORMS); do $(MAKE) --no-print-directory ENVIRONMENT=$$each build || exit; done
	$(VENV) benchmarks/platforms.py $(RECORD) .venv $(PLATFORMS:%=.venv-%)

bench-latency: build
	$(IN_OWN_DOMAIN) $(VENV) benchmarks/latency.py --keep

bench-loop-rate: build
	$(IN_OWN_DOMAIN) $(VENV) benchmarks/loop_rate.py

bench-oscillation: build
	OPENBLAS_NUM_THREADS=1 $(VENV) -m benchmarks.oscillation

bench-tune: build
	OPENBLAS_NUM_THREADS=1 $(VENV) benchmarks/tune.py

bench-learning: build
	OPENBLAS_NUM_THREADS=1 $(VENV) benchmarks/learning.py $(LEARNING)

bench-driver: build
	$(IN_OWN_DOMAIN) $(VENV) benchmarks/driver.py

bench-device-faults: build
	$(IN_OWN_DOMAIN) $(VENV) benchmarks/device_faults.py

bench-device-lives: build
	$(IN_OWN_DOMAIN) $(VENV) benchmarks/device_lives.py

bench-surroundings: build
	$(VENV) benchmarks/surroundings.py

bench-restarts: build
	$(IN_OWN_DOMAIN) $(VENV) benchmarks/restarts.py $(RESTARTS)

bench-company: build
	$(IN_OWN_DOMAIN) $(VENV) benchmarks/company.py $(COMPANY)

bench-soak: build
	$(IN_OWN_DOMAIN) $(VENV) benchmarks/soak.py

bench-trajectory: build
	$(IN_OWN_DOMAIN) $(VENV) benchmarks/trajectory.py

bench-readme: build
	$(IN_OWN_DOMAIN) $(VENV) -m benchmarks.readme_steps

bench-steps: build
	$(IN_OWN_DOMAIN) env PYTHONPATH=.:test $(VENV) -m benchmarks.steps $(STEPS)

bench-faults: build
	$(IN_OWN_DOMAIN) $(VENV) benchmarks/faults.py $(FAULTS)

# A tool of its own environment: what it needs is not what the package needs. A package that could not be asked for is a
# failure (--strict), as nothing is known of it then.
audit:
	@test -x .audit/bin/pip-audit || { $(or $(PYTHON),python3) -m venv .audit && .audit/bin/pip install -q pip-audit; }
	.audit/bin/pip-audit --strict --disable-pip --no-deps -r requirements/lock.txt

bench-lies: build
	$(VENV) benchmarks/sensor_lies.py

bench-rate-law: build
	OPENBLAS_NUM_THREADS=1 $(VENV) benchmarks/rate_law.py

bench-foreign: build
	OPENBLAS_NUM_THREADS=1 $(VENV) benchmarks/foreign.py

bench-no-harm: build
	OPENBLAS_NUM_THREADS=1 $(VENV) benchmarks/no_harm.py

# Tables of SLPI_MEASURED_DATA, else of ../shared/data; python -m benchmarks.measured.fetch makes them.
bench-measured: build
	OPENBLAS_NUM_THREADS=1 $(VENV) -m benchmarks.measured.bench --keep
	$(VENV) -m benchmarks.measured.report
	$(VENV) -m benchmarks.measured.loop

bench-twins: build
	OPENBLAS_NUM_THREADS=1 $(VENV) -m benchmarks.measured.twins

bench-agreement: build
	$(IN_WORKSPACE) PYTHONPATH=.:test OPENBLAS_NUM_THREADS=1 $(VENV) benchmarks/agreement.py

bench-calibrator: build
	$(IN_OWN_DOMAIN) $(VENV) benchmarks/calibrator_faults.py

bench-confusion: build
	OPENBLAS_NUM_THREADS=1 $(VENV) benchmarks/confusion.py

bench-promise: build
	OPENBLAS_NUM_THREADS=1 $(VENV) benchmarks/promise.py

bench-coverage: build
	OPENBLAS_NUM_THREADS=1 $(VENV) benchmarks/uncertainty.py $(COVERAGE)

bench-fleet: build
	OPENBLAS_NUM_THREADS=1 $(VENV) benchmarks/fleet.py

# Tools of 1 GB, so that neither `make test` nor anybody else needs them.
test-export-arm: build
	@command -v arm-none-eabi-gcc >/dev/null && command -v qemu-system-arm >/dev/null || { apt-get update && apt-get \
		install -y --no-install-recommends gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm; }
	PYTHONPATH=.:test $(VENV) test/export/run_arm.py

bench-export: build
	OPENBLAS_NUM_THREADS=1 $(VENV) benchmarks/export.py

clean:
	rm -rf build build-* install install-* log log-* dist docs/_build .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -path './.venv*' -prune -o -name __pycache__ -prune -exec rm -rf {} +

distclean: clean
	rm -rf .venv .venv-* .audit slpi_ros.egg-info
