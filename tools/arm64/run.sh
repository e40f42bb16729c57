#!/bin/sh
# orthonav on 64-bit ARM, emulated by QEMU; see README.md here.
#     tools/arm64/run.sh WORK [fixes|fly|tests|rebuild|python] [arguments]
# WORK is a folder for the Debian files and the wheels (0.9 GB), made on the first run.
set -eu
if [ $# -lt 1 ]; then
    sed -n 2,4p "$0" >&2
    exit 2
fi
mkdir -p "$1"
work=$(cd "$1" && pwd)
step=${2:-all}
shift; [ $# -eq 0 ] || shift
checkout=$(cd "$(dirname "$0")/../.." && pwd)
suite=${SUITE:-bookworm}
# The processor of a Raspberry Pi 4. QEMU's own default, max, has SME, with which OpenBLAS's
# products of matrices are NaN under QEMU 7.2.
export QEMU_CPU="${QEMU_CPU:-cortex-a72}"
golden=$checkout/tests/data/golden_flight

for needed in qemu-aarch64-static mmdebstrap python3; do
    command -v "$needed" >/dev/null || {
        echo "$needed is missing: apt install qemu-user-static mmdebstrap python3-venv" >&2
        exit 1
    }
done

if [ ! -e "$work/root/.done" ]; then
    echo "Debian $suite for arm64: unpacked only, nothing of it runs but Python" >&2
    rm -rf "$work/root" && mkdir "$work/root"
    # Through a tar file, so that all files belong to the user, also in a user namespace.
    mmdebstrap --quiet --arch=arm64 --variant=extract --format=tar \
        --hook-dir=/usr/share/mmdebstrap/hooks/merged-usr \
        --include=python3,libstdc++6,libpython3-dev \
        "$suite" - | tar -x -C "$work/root" --exclude=./dev --no-same-owner
    touch "$work/root/.done"
fi
python=$(ls "$work/root/usr/bin" | grep -E '^python3\.[0-9]+$')

if [ ! -e "$work/site/.done" ]; then
    echo "wheels of orthonav[autopilot,geo,signing] and pytest for aarch64 and $python" >&2
    rm -rf "$work/site" "$work/pip"
    python3 -m venv "$work/pip"
    "$work/pip/bin/pip" install --quiet --target "$work/site" --only-binary=:all: \
        --platform manylinux2014_aarch64 --platform manylinux_2_28_aarch64 \
        --implementation cp --python-version "${python#python}" -c "$checkout/constraints.txt" \
        "$checkout[autopilot,geo,signing]" pytest pytest-timeout pytest-xdist hypothesis pynmeagps
    rm -rf "$work/site/orthonav"  # the checkout itself is run
    touch "$work/site/.done"
fi

# The package as links, in which the kernel of arm64 takes the place of that of this machine.
kernel=orthonav/core/register/_kernel
rm -rf "$work/src" && mkdir "$work/src" && cp -rs "$checkout/src/orthonav" "$work/src/"
rm -f "$work/src/$kernel".*so
if command -v aarch64-linux-gnu-gcc >/dev/null; then
    aarch64-linux-gnu-gcc -O3 -fno-math-errno -fno-trapping-math -shared -fPIC "-I$work/root/usr/include/$python" \
        -idirafter "$work/root/usr/include" -o "$work/src/$kernel.abi3.so" \
        -Wno-psabi "$checkout/src/orthonav/core/register"/_*.c -lm
else
    echo "aarch64-linux-gnu-gcc is missing: NumPy takes the place of the kernel" >&2
fi

# The emulated Python is a script that gives its own name to Python, as sys.executable: processes
# started with it are emulated too, whatever their environment.
cat >"$work/python" <<EOF
#!/bin/sh
export QEMU_CPU="$QEMU_CPU" PYTHONHOME="$work/root/usr" PYTHONDONTWRITEBYTECODE=1
export PYTHONPATH="$work/src:$work/site"
exec "\${QEMU:-qemu-aarch64-static}" -0 "$work/python" -L "$work/root" "$work/root/usr/bin/$python" "\$@"
EOF
chmod +x "$work/python"
emulated() { "$work/python" "$@"; }
orthonav() { emulated -c 'import sys; from orthonav.cli import main; sys.exit(main())' "$@"; }
asked() { [ "$step" = all ] || [ "$step" = "$1" ]; }

cd "$checkout"
if asked fixes; then emulated tools/platforms/fixes.py "$@"; fi
if asked fly; then
    rm -f "$work/fly.jsonl"  # lines are added to what there is
    # Slower than it was flown: an emulated view takes seconds. It ends where the flight ends.
    orthonav fly "$golden/area.onav" "$golden/flight" --recorded-telemetry --pace 0.1 \
        --dry-run --autopilot udpin:0 --jsonl "$work/fly.jsonl"
    emulated -c "import collections, json; lines = map(json.loads, open('$work/fly.jsonl'))
print('flown:', collections.Counter(line.get('status', 'health') for line in lines))"
fi
if asked tests; then
    [ $# -gt 0 ] || set -- -m "not slow" tests/geo tests/flight tests/mapfile tests/register \
        tests/track tests/messages tests/localize tests/test_golden.py
    emulated -m pytest -p no:cacheprovider --durations=10 "$@"
fi
if [ "$step" = rebuild ]; then emulated tools/platforms/fixes.py --rebuild --run views; fi
if [ "$step" = python ]; then emulated "$@"; fi
