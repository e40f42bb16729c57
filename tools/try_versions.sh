#!/bin/sh
# try_versions.sh PYTHON lowest|newest [PYTEST-ARGUMENT...]: do the tests pass with these versions?
#
# Makes an environment of PYTHON in a temporary folder, with the lowest versions of dependencies that
# pyproject.toml allows or with the newest there are, installs orthonav and runs the demo and the tests
# (or what the arguments choose of them) there. PyTorch and Ray are left out, and their tests skipped.
# EXTRAS says what else to install: "test" unless set; EXTRAS=test,neural adds onnxruntime.
set -eu
if [ $# -lt 2 ] || { [ "$2" != lowest ] && [ "$2" != newest ]; }; then
    sed -n '2,7s/^# \{0,1\}//p' "$0" >&2
    exit 2
fi
python=$1
which=$2
shift 2
case $which in
lowest) resolution=lowest-direct ;;
newest) resolution=highest ;;
esac
cd "$(dirname "$0")/.."
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT INT TERM

"$python" -m venv "$work/tools"
"$work/tools/bin/python" -m pip install --quiet --disable-pip-version-check uv
uv="$work/tools/bin/uv"
"$uv" venv --quiet --python "$python" "$work/venv"
"$uv" pip install --quiet --python "$work/venv/bin/python" --resolution "$resolution" \
    -e ".[${EXTRAS:-test}]"
echo "== $("$work/venv/bin/python" -V), $which"
"$uv" pip list --python "$work/venv/bin/python" --format freeze
(cd "$work" && venv/bin/orthonav demo --out demo)
if [ $# -eq 0 ]; then
    set -- -n auto --dist loadfile
fi
"$work/venv/bin/python" -m pytest -p no:cacheprovider -rs "$@"
