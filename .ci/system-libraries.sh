#!/bin/sh
# Are the system libraries there that Blender's Python module loads, and what makes virtual environments?
# As root on Debian or Ubuntu the missing ones are installed; otherwise the line that does it is printed.
# Usage: system-libraries.sh PYTHON
set -eu
python=$1

if ! command -v "$python" >/dev/null; then
    echo "error: $python is not on this machine; Blender's module needs Python 3.11 or 3.13 (make PYTHON=...)" >&2
    exit 1
fi
[ "$(uname -s)" = Linux ] || exit 0

missing=""
while read -r library package; do
    "$python" -c "import ctypes; ctypes.CDLL('$library')" 2>/dev/null || missing="$missing $package"
done <<END
libX11.so.6 libx11-6
libXrender.so.1 libxrender1
libXfixes.so.3 libxfixes3
libXi.so.6 libxi6
libxkbcommon.so.0 libxkbcommon0
libSM.so.6 libsm6
libGL.so.1 libgl1
END
version=$("$python" -c "import sys; print('%d.%d' % sys.version_info[:2])")
"$python" -c "import ensurepip, venv" 2>/dev/null || missing="$missing python$version-venv"
[ -n "$missing" ] || exit 0

if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "Installing system libraries that Blender needs:$missing" >&2
    export DEBIAN_FRONTEND=noninteractive
    apt-get update --quiet=2
    # shellcheck disable=SC2086 -- one word each
    apt-get install --quiet=2 --yes --no-install-recommends $missing >/dev/null
else
    echo "error: system libraries that Blender needs are missing. Install them, then try again:" >&2
    echo "    sudo apt-get install --no-install-recommends$missing" >&2
    exit 1
fi
