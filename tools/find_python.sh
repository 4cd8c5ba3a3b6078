#!/bin/sh
# Print the first Python of some versions that imports some modules:
# tools/find_python.sh "3.11 3.12" "ensurepip, venv" [CANDIDATE...]
# Candidates: $PYTHON, those given, python3, python3.12, ..., then what pyenv and uv have installed, active or not.
# It is followed to the program itself: no venv, no version manager's proxy.
set -eu
versions=$1 modules=$2
shift 2

first() {
    for candidate in "$@"; do
        real=$("$candidate" -c 'import os, sys; print(os.path.realpath(sys._base_executable))' 2>/dev/null) || continue
        version=$("$real" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null) || continue
        case " $versions " in *" $version "*) ;; *) continue ;; esac
        # Debian and Ubuntu have no ensurepip unless python3-venv is installed.
        if "$real" -c "import $modules" 2>/dev/null; then
            echo "$real"
            exit
        fi
    done
}

first ${PYTHON:+"$PYTHON"} "$@" python3
# Newer versions first.
for version in $(printf '%s\n' $versions | sort -t. -k2nr); do
    first "python$version" \
        "${PYENV_ROOT:-$HOME/.pyenv}/versions/$version".*/bin/"python$version" \
        "${UV_PYTHON_INSTALL_DIR:-$HOME/.local/share/uv/python}/cpython-$version".*/bin/"python$version"
done
exit 1
