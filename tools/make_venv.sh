#!/bin/sh
# Make the environment of this checkout that is named: tools/make_venv.sh [jazzy | minimum | newest | kilted], .venv
# without a name. On top of a sourced ROS 2 Jazzy, or with ROS 2 Jazzy from wheels where none is sourced; kilted: the
# newest versions with ROS 2 Kilted.
# An existing environment keeps its Python; $PYTHON or the first one that tools/find_python.sh finds makes a new one.
set -eu
cd "$(dirname "$0")/.."

fail() { echo "slpi_ros: $*" >&2; exit 1; }

# The pins of an environment: each file overrides versions of the file before it.
name=${1:-} distro=jazzy preferred=
case "$name" in
    '') versions='3.11 3.12' pins=requirements/lock.txt ;;
    jazzy) versions=3.12 pins='requirements/lock.txt requirements/jazzy.txt' ;;
    minimum) versions=3.11 pins='requirements/lock.txt requirements/jazzy.txt requirements/minimum.txt' ;;
    newest) versions='3.12 3.13 3.14' preferred=3.13 pins= ;;
    kilted) versions='3.12 3.13 3.14' preferred=3.13 pins= distro=kilted ;;
    *) fail "no environment '$name'; give jazzy, minimum, newest or kilted" ;;
esac
venv=.venv${name:+-$name}

flavour=wheels python=
case "${ROS_DISTRO:-}" in
    '') ;;
    "$distro") python=$(tools/find_python.sh "$versions" 'ensurepip, venv, rclpy' $venv/bin/python) && flavour=sourced || true ;;
    *) fail "ROS 2 $ROS_DISTRO is sourced, but $distro is needed: use a shell that sources $distro or no ROS at all" ;;
esac
# The preferred Python where it is there and no other one is asked for, though python3 would do.
[ -z "$preferred" ] || [ -n "$python${PYTHON:-}" ] || python=$(tools/find_python.sh "$preferred" 'ensurepip, venv') || true
[ -n "$python" ] || python=$(tools/find_python.sh "$versions" 'ensurepip, venv' $venv/bin/python) ||
    fail "no Python $(echo $versions | sed 's/ / or /') with venv among ${PYTHON:+$PYTHON, }python3, $(printf 'python%s, ' $versions)pyenv's and" \
        "uv's: install one (apt install python3-venv, or pyenv install 3.12), or run make with PYTHON=/path/to/python3.12"

# A venv cannot be moved nor change its Python: anything but the very same one is made anew.
identity="$flavour $python $("$python" -V) $PWD"
if [ -z "$pins" ] || [ "$(cat $venv/.identity 2>/dev/null)" != "$identity" ]; then
    echo "slpi_ros: making $venv with $("$python" -V) ($python), ROS 2 $distro: $flavour; this takes a minute or two"
    rm -rf $venv
    if [ "$flavour" = sourced ]; then site=--system-site-packages; else site=; fi
    "$python" -m venv $site $venv
fi

pip() { $venv/bin/python -m pip install -qq --disable-pip-version-check "$@"; }
if [ -z "$pins" ]; then
    pip -r requirements/build.txt
    # All in one go, so that one package's limits on another one are kept.
    [ $flavour = sourced ] || ros="-r requirements/$([ $distro = jazzy ] && echo ros || echo $distro).txt"
    pip --no-build-isolation --use-pep517 -r requirements/build.txt ${ros:-} -e '.[docs,test]'
else
    # What the sourced ROS and the system bring stays as it is; only what pip adds is pinned, and checked by its hashes.
    $venv/bin/python - $flavour $pins >$venv/lock.txt <<'PY'
import re, sys
from importlib.metadata import distributions

def plain(name): return re.sub(r"[-_.]+", "-", name).lower()

flavour, *files = sys.argv[1:]
pins = {}
for file in files:
    # A pin and its hashes are one line, continued by backslashes.
    for pin in re.split(r"(?<!\\)\n", open(file).read()):
        if "==" in pin and not pin.startswith("#"):
            pins[plain(pin.split("==")[0])] = pin
if flavour == "sourced":
    present = {plain(d.name) for d in distributions() if not d.locate_file("").is_relative_to(sys.prefix)}
    pins = {name: pin for name, pin in pins.items() if name not in present and not name.startswith("ros-")}
print("\n".join(pins.values()))
PY
    pip --require-hashes --no-deps -r $venv/lock.txt
    # Everything that the package needs is there: without an index, a dependency that the lock lacks is an error.
    pip --no-index --no-build-isolation --use-pep517 -e '.[docs,test]'
fi
echo "$identity" >$venv/.identity
