#!/usr/bin/env bash
# Native libraries that Open3D loads and pip cannot bring; with the argument `browser`, a Chromium for the tests as well.
# Installs them when root on Debian or Ubuntu, else names them.
set -euo pipefail

declare -A package_of=(
  [libusb-1.0.so.0]=libusb-1.0-0
  [libGL.so.1]=libgl1
  [libgomp.so.1]=libgomp1
  [libX11.so.6]=libx11-6
)

loadable=$(/sbin/ldconfig -p 2>/dev/null || ldconfig -p)
missing=()
for library in "${!package_of[@]}"; do
  grep -q "$library" <<<"$loadable" || missing+=("${package_of[$library]}")
done
if [ "${1:-}" = browser ] && ! command -v chromium chromium-browser google-chrome >/dev/null; then missing+=(chromium); fi
if ! "${PYTHON:-python3}" -c 'import ensurepip, venv' 2>/dev/null; then missing+=(python3-venv); fi
[ ${#missing[@]} -eq 0 ] && exit 0

if [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null; then
  echo "installing ${missing[*]}"
  apt-get update -qq
  DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
else
  echo "error: system libraries are missing; run: sudo apt-get install ${missing[*]}" >&2
  exit 1
fi
