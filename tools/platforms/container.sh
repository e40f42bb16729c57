#!/bin/sh
# Builds examples/Containerfile with buildah and places the views of tests/data/golden_flight in it.
#     tools/platforms/container.sh WORK [IMAGE]
# IMAGE is the base (default: that of the Containerfile, from its registry); `debian` makes one out
# of Debian's packages by mmdebstrap, where there is no registry. WORK holds the images.
# Needs buildah and, for debian, mmdebstrap; as root or in a user namespace; no daemon.
set -eu
checkout=$(cd "$(dirname "$0")/../.." && pwd)
mkdir -p "$1"
work=$(cd "$1" && pwd)
base=${2:-}
export STORAGE_DRIVER=vfs BUILDAH_ISOLATION=chroot

image() { buildah --root "$work/images" --runroot "$work/run" "$@"; }

if [ "$base" = debian ]; then
    base=localhost/debian-python
    if ! image inspect --type image "$base" >/dev/null 2>&1; then
        mmdebstrap --quiet --variant=minbase --include=python3,python3-pip \
            "${SUITE:-bookworm}" "$work/debian.tar"
        container=$(image from scratch)
        image add --quiet "$container" "$work/debian.tar" / >/dev/null
        # What this machine's pip needs: its certificates, and leave to install beside Debian's.
        image config --env PIP_BREAK_SYSTEM_PACKAGES=1 "$container"
        if [ -n "${PIP_CERT:-}" ]; then
            image copy --quiet "$container" "$PIP_CERT" /etc/pip-cert.crt >/dev/null
            image config --env PIP_CERT=/etc/pip-cert.crt "$container"
        fi
        image commit --quiet "$container" "$base" >/dev/null
        image rm "$container" >/dev/null
        rm "$work/debian.tar"
    fi
fi

# Only what the Containerfile copies: a context of the whole checkout would take environments along.
rm -rf "$work/context" && mkdir "$work/context"
for name in pyproject.toml constraints.txt PYPI.md LICENSE src examples; do
    cp -r "$checkout/$name" "$work/context/$name"
done
image build --quiet ${base:+--build-arg "BASE=$base"} -t localhost/orthonav \
    -f "$work/context/examples/Containerfile" "$work/context"
container=$(image from localhost/orthonav)
trap 'image rm "$container" >/dev/null' EXIT
golden=$checkout/tests/data/golden_flight
image run -v "$golden:/flight:ro" "$container" -- orthonav fly --help >/dev/null
image run -v "$golden:/flight:ro" "$container" -- \
    orthonav localize /flight/area.onav /flight/flight --out /tmp/fixes.jsonl
image run "$container" -- sh -c 'id -un; du -sh /usr/local/lib/python3*/dist-packages 2>/dev/null ||
    du -sh /usr/local/lib/python3*/site-packages'
