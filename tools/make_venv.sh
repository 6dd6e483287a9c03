#!/usr/bin/env bash
# Makes the development environment: a venv, the pinned packages with their hashes, and the project itself, editable.
set -euo pipefail
python=${1:-python3} venv=${2:-.venv}

if ! command -v "$python" >/dev/null; then
  echo "no '$python' here; Fringescope needs Python 3.11 or newer (Debian, Ubuntu: apt-get install python3 python3-venv)" >&2
  exit 1
fi
version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
if ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then
  echo "'$python' is Python $version; Fringescope needs 3.11 or newer: make PYTHON=python3.11 ..." >&2
  exit 1
fi
if [ ! -x "$venv/bin/pip" ]; then
  if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
    echo "Python $version here has no venv module (Debian, Ubuntu: apt-get install python$version-venv)" >&2
    exit 1
  fi
  "$python" -m venv "$venv"
fi
echo "installing the pinned packages into $venv (about a minute the first time)"
"$venv/bin/pip" install --quiet --disable-pip-version-check --require-hashes -r constraints/dev.txt
"$venv/bin/pip" install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
# what has no wheel and is compiled: without a compiler the tests that need it are skipped, by name
if ! "$venv/bin/pip" install --quiet --disable-pip-version-check --require-hashes -r constraints/meshopt.txt; then
  echo "meshoptimizer could not be built (Debian, Ubuntu: apt-get install g++ python3-dev): tests of packed surfaces will be skipped"
fi
