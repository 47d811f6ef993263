#!/bin/sh
# Installs what the examples and tests need and is missing. Says what it did.
set -eu

apt_packages="gcc g++ make libmetis-dev libcjson-dev libpng-dev libcmocka-dev"
dnf_packages="gcc gcc-c++ make metis-devel cjson-devel libpng-devel libcmocka-devel"
brew_packages="metis cjson libpng cmocka libomp"

sudo=
[ "$(id -u)" = 0 ] || sudo=sudo

if command -v apt-get >/dev/null 2>&1; then
    missing=
    for p in $apt_packages; do
        dpkg-query -W -f='${Status}' "$p" 2>/dev/null | grep -q 'install ok installed' || missing="$missing $p"
    done
    [ -n "$missing" ] || { echo "deps: nothing to install"; exit 0; }
    echo "deps: installing$missing"
    $sudo apt-get update -qq
    DEBIAN_FRONTEND=noninteractive $sudo apt-get install -y -qq --no-install-recommends $missing >/dev/null
elif command -v dnf >/dev/null 2>&1; then
    missing=
    for p in $dnf_packages; do rpm -q "$p" >/dev/null 2>&1 || missing="$missing $p"; done
    [ -n "$missing" ] || { echo "deps: nothing to install"; exit 0; }
    echo "deps: installing$missing"
    $sudo dnf install -y -q $missing
elif command -v brew >/dev/null 2>&1; then
    missing=
    for p in $brew_packages; do brew list "$p" >/dev/null 2>&1 || missing="$missing $p"; done
    [ -n "$missing" ] || { echo "deps: nothing to install"; exit 0; }
    echo "deps: installing$missing"
    brew install $missing
else
    echo "deps: no apt, dnf or brew here; please install: METIS, cJSON, libpng, cmocka" >&2
    exit 1
fi
echo "deps: done"
