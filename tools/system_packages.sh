#!/usr/bin/env bash
# Installs the system packages that the project's own tasks use, on Debian and Ubuntu. To install `fringescope` alone, Python
# and pip are enough.
#
#   python3-venv     make: the environment in .venv
#   g++, python3-dev meshoptimizer, which comes as source: surfaces packed for the wire
#   make, git        the tasks; tests that look at the tracked files
#   nodejs, npm      Khronos' glTF validator, which judges surface.glb; a TypeScript compiler, which judges the page's
#                    types; checks of the viewer page's script
#   poppler-utils    prints board.pdf to a picture, as an outside reader of it
#   postgresql       the hub's tests on PostgreSQL, which start a server of their own
#   chromium         opens the viewer page without a screen and looks whether it draws
#
# A package that cannot be had costs only the tests that need it; they are skipped and say so by name.
set -uo pipefail

if ! command -v apt-get >/dev/null; then
  echo "system packages: no apt-get here; install by hand what you miss: python3-venv g++ python3-dev make git nodejs npm poppler-utils chromium postgresql"
  exit 0
fi
wanted=()
command -v make >/dev/null || wanted+=(make)
command -v git >/dev/null || wanted+=(git)
python3 -c 'import ensurepip, venv' 2>/dev/null || wanted+=(python3-venv)
command -v c++ >/dev/null || wanted+=(g++)
python3 -c 'import sysconfig, os, sys; sys.exit(not os.path.exists(sysconfig.get_path("include") + "/Python.h"))' 2>/dev/null || wanted+=(python3-dev)
command -v node >/dev/null || wanted+=(nodejs)
command -v npm >/dev/null || wanted+=(npm)
command -v pdftoppm >/dev/null || wanted+=(poppler-utils)
command -v chromium >/dev/null || command -v chromium-browser >/dev/null || command -v google-chrome >/dev/null || wanted+=(chromium)
command -v initdb >/dev/null || compgen -G "/usr/lib/postgresql/*/bin/initdb" >/dev/null || wanted+=(postgresql)
if [ ${#wanted[@]} -eq 0 ]; then
  echo "system packages: all there"
  exit 0
fi
if [ "$(id -u)" -ne 0 ]; then
  echo "system packages: run as root to install: apt-get install ${wanted[*]}"
  exit 0
fi
echo "system packages: installing ${wanted[*]}"
export DEBIAN_FRONTEND=noninteractive
apt-get update -qq || echo "system packages: the package list could not be renewed; trying with the old one"
for package in "${wanted[@]}"; do
  if ! apt-get install -y -qq --no-install-recommends "$package" >/dev/null 2>&1; then
    echo "system packages: $package could not be installed; the tests that need it will be skipped"
  fi
done
