#!/bin/sh
# install.sh PYTHON EXTRAS: say how much that is, then install this checkout with these extras and the
# versions of constraints.txt into the environment of PYTHON. Figures: tools/measure_install.sh.
set -eu
python=$1
extras=$2
cd "$(dirname "$0")/.."
size=$(awk -v extras="$extras" '$1 == extras { print $2 " MB to download, " $3 " MB on disk" }' \
    tools/install_sizes.txt)
echo "installing orthonav[$extras]: ${size:-size not measured}"
case $extras in
*dev* | *train*)
    echo "  (with the CPU build of PyTorch; a build with CUDA, which pip may choose, is several GB more)"
    ;;
esac
"$python" -m pip install --disable-pip-version-check -c constraints.txt -e ".[$extras]"
size=$(du -sm "$("$python" -c 'import sys; print(sys.prefix)')" | cut -f1)
echo "installed orthonav[$extras]: the environment takes $size MB"
