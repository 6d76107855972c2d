#!/bin/sh
# A browser for the tests of the viewer: any Chromium will do, and Debian's chromium-headless-shell is the smallest.
# Installs it when it may, otherwise says in one line what to install.
set -eu

for program in ${SPICD_TEST_BROWSER:-chromium-headless-shell chromium chromium-browser google-chrome}; do
    ! command -v "$program" >/dev/null || exit 0
done

package=chromium-headless-shell
if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "Installing $package (Debian's name) for the tests of the viewer"
    export DEBIAN_FRONTEND=noninteractive
    { apt-get update -qq && apt-get install -y -qq --no-install-recommends "$package"; } >/dev/null
else
    echo "No browser: install a Chromium, e.g. (Debian): sudo apt-get install $package" >&2
    exit 1
fi
