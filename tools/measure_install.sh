#!/bin/sh
# measure_install.sh PYTHON EXTRAS...: rewrite the rows of tools/install_sizes.txt for these sets of
# extras (such as "dev" or "geo,report,fetch,web"): MB downloaded, MB of the environment afterwards.
set -eu
python=$1
shift
cd "$(dirname "$0")/.."
sizes=tools/install_sizes.txt
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT INT TERM
for extras in "$@"; do
    rm -rf "$work/wheels" "$work/venv"
    "$python" -m venv "$work/venv"
    pip="$work/venv/bin/python -m pip --quiet --disable-pip-version-check"
    $pip download -c constraints.txt -d "$work/wheels" ".[$extras]" 'setuptools>=77'
    $pip install --no-index --find-links "$work/wheels" -c constraints.txt -e ".[$extras]"
    downloaded=$(du -sm "$work/wheels" | cut -f1)
    installed=$(du -sm "$work/venv" | cut -f1)
    grep -v "^$extras " "$sizes" >"$work/sizes" || true
    echo "$extras $downloaded $installed" >>"$work/sizes"
    cp "$work/sizes" "$sizes"
    echo "$extras: $downloaded MB downloaded, $installed MB installed"
done
