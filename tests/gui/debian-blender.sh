#!/bin/sh
# A Blender with an interface, a virtual display and what takes screenshots: Debian trixie's, in a folder of its own.
# Usage: debian-blender.sh FOLDER. Root only. A folder that is complete is left as it is.
# The packages come from where this machine's apt takes its own.
set -eu
root=$1
[ ! -e "$root/complete" ] || exit 0

mirror=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' 'Origin: Debian' | head -n 1)
if [ -z "$mirror" ]; then
    echo "error: this machine's apt knows no Debian mirror; run apt-get update" >&2
    exit 1
fi
rm -rf "$root"
mkdir -p "$root"
debootstrap --variant=minbase trixie "$root" "$mirror"
DEBIAN_FRONTEND=noninteractive chroot "$root" apt-get install --quiet=2 --yes --no-install-recommends \
    blender python3-numpy libgl1-mesa-dri xvfb xauth x11-apps xdotool netpbm procps
chroot "$root" apt-get clean
touch "$root/complete"
