#!/bin/sh
# Run a command on a virtual display in the system of FOLDER, where SHARED is /shared and all else is out of reach.
# Usage: unshare --mount --pid --fork --kill-child on-display.sh FOLDER SHARED SIZE COMMAND...
# In namespaces of their own, what is mounted and started here is gone with the command.
set -eu
root=$1 shared=$2 size=$3
shift 3
mkdir -p "$root/shared"
mount --bind "$shared" "$root/shared"
mount -t proc proc "$root/proc"
mount -t tmpfs tmpfs "$root/tmp"
mount --rbind /dev "$root/dev"
mount -t tmpfs tmpfs "$root/dev/shm"
# xvfb-run waits for a signal that never reaches the first process of a namespace: the shell must stay that.
chroot "$root" env -i PATH=/usr/bin:/bin LANG=C.UTF-8 HOME=/shared/home XDG_RUNTIME_DIR=/tmp LIBGL_ALWAYS_SOFTWARE=1 \
    BLENDER_USER_RESOURCES=/shared/user \
    xvfb-run --auto-servernum --server-args="-screen 0 ${size}x24 -nolisten tcp" "$@"
