#!/bin/sh
# Make .venv for this checkout: on top of a sourced ROS 2 Jazzy, or with ROS 2 Jazzy from wheels where none is sourced.
# Candidates for Python: $PYTHON, that of an existing .venv (which then stays), python3, python3.12, python3.11.
set -eu
cd "$(dirname "$0")/.."

fail() { echo "slpi_ros: $*" >&2; exit 1; }

# Print the first Python 3.11 or 3.12 that imports what it has to, followed to the program itself:
# no venv, no version manager's proxy. (Debian and Ubuntu have no ensurepip unless python3-venv is installed.)
first_python() {
    for candidate in ${PYTHON:+"$PYTHON"} .venv/bin/python python3 python3.12 python3.11; do
        real=$("$candidate" -c 'import os, sys; print(os.path.realpath(sys._base_executable))' 2>/dev/null) || continue
        if "$real" -c "import sys, $1; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)))" 2>/dev/null; then
            echo "$real"
            return
        fi
    done
}

flavour=wheels python=
case "${ROS_DISTRO:-}" in
    '') ;;
    jazzy) python=$(first_python 'ensurepip, venv, rclpy'); [ -z "$python" ] || flavour=sourced ;;
    *) fail "ROS 2 $ROS_DISTRO is sourced, but jazzy is needed: use a shell that sources jazzy or no ROS at all" ;;
esac
[ -n "$python" ] || python=$(first_python 'ensurepip, venv')
[ -n "$python" ] || fail "no Python 3.11 or 3.12 with venv among ${PYTHON:+$PYTHON, }python3, python3.12, python3.11:" \
    "install one (apt install python3-venv), or run 'make build PYTHON=/path/to/python3.12'"

# A venv cannot be moved nor change its Python: anything but the very same one is made anew.
identity="$flavour $python $("$python" -V) $PWD"
if [ "$(cat .venv/.identity 2>/dev/null)" != "$identity" ]; then
    echo "slpi_ros: making .venv with $("$python" -V) ($python), ROS 2 Jazzy: $flavour; this takes a minute or two"
    rm -rf .venv
    if [ "$flavour" = sourced ]; then site=--system-site-packages; else site=; fi
    "$python" -m venv $site .venv
fi

# What the sourced ROS and the system bring stays as it is; only what pip adds is pinned, and checked by its hashes.
lock=.venv/lock.txt
if [ "$flavour" = sourced ]; then
    .venv/bin/python - requirements/lock.txt >$lock <<'PY'
import re, sys
from importlib.metadata import distributions

def plain(name): return re.sub(r"[-_.]+", "-", name).lower()

present = {plain(d.name) for d in distributions() if not d.locate_file("").is_relative_to(sys.prefix)}
# A pin and its hashes are one line, continued by backslashes.
for pin in re.split(r"(?<!\\)\n", open(sys.argv[1]).read()):
    name = plain(pin.split("==")[0])
    if name not in present and not name.startswith("ros-"):
        print(pin)
PY
else
    cp requirements/lock.txt $lock
fi

pip() { .venv/bin/python -m pip install -qq --disable-pip-version-check "$@"; }
pip --require-hashes --no-deps -r $lock
# Everything that the package needs is there: without an index, a dependency that the lock lacks is an error.
pip --no-index --no-build-isolation --use-pep517 -e '.[docs,test]'
echo "$identity" >.venv/.identity
