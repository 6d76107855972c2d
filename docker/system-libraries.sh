#!/bin/sh
# Open3D's wheel links to libusb, libGL and libgomp, which a bare Debian or Ubuntu does not have.
# Installs what is missing when it may, otherwise says in one line what to install.
set -eu

missing=""
for pair in libusb-1.0.so.0:libusb-1.0-0 libGL.so.1:libgl1 libgomp.so.1:libgomp1; do
    library=${pair%%:*}
    "${PYTHON:-python3}" -c "import ctypes; ctypes.CDLL('$library')" 2>/dev/null || missing="$missing ${pair##*:}"
done
[ -n "$missing" ] || exit 0

if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "Installing the libraries that Open3D needs:$missing"
    export DEBIAN_FRONTEND=noninteractive
    # shellcheck disable=SC2086  # a list of package names
    { apt-get update -qq && apt-get install -y -qq --no-install-recommends $missing; } >/dev/null
else
    echo "Open3D needs:$missing (Debian and Ubuntu names). Install them, e.g.: sudo apt-get install$missing" >&2
    exit 1
fi
