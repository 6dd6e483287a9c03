#!/usr/bin/env bash
# Resolves constraints/core.txt, dev.txt, gpu.txt and meshopt.txt from pyproject.toml: one set of versions for Python 3.11 to 3.13 on
# every platform, with hashes and without the address of any index. Commit the files.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${1:-python3}
if [ ! -x build/lock/bin/uv ]; then
  "$python" -m venv build/lock
  build/lock/bin/pip install --quiet --disable-pip-version-check uv
fi
resolve() {
  build/lock/bin/uv pip compile pyproject.toml --quiet --universal --python-version 3.11 --fork-strategy fewest \
    --generate-hashes --no-emit-index-url --no-emit-find-links --no-annotate --no-header --upgrade "$@"
}
resolve --output-file constraints/core.txt
resolve --output-file constraints/dev.txt --extra dev --constraint constraints/core.txt
resolve --output-file constraints/gpu.txt --extra gpu --constraint constraints/core.txt
resolve --output-file constraints/meshopt.txt --extra meshopt --constraint constraints/core.txt --prerelease if-necessary-or-explicit
echo "constraints/core.txt: $(grep -c '^[a-z]' constraints/core.txt) packages; constraints/dev.txt: $(grep -c '^[a-z]' constraints/dev.txt)"
