#!/usr/bin/env bash
# The device benchmark on a machine without network:
#   bench/carry.sh pack [PYTHON]    here, with an index: carried.tar.xz, what the benchmark needs, for that
#                                   version of Python (3.11; this one's by default) on this processor
#   bench/carry.sh run [OPTIONS]    there, with the checkout and the archive: options are bench_device.py's
set -euo pipefail
cd "$(dirname "$0")/.."
what=${1:-}
archive=carried.tar.xz
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

case $what in
pack)
  version=${2:-$(python -c 'import sys; print("%d.%d" % sys.version_info[:2])')}
  # The package itself is run from the checkout: of it only what it requires is fetched.
  mapfile -t requires < <(python -c '
import configparser
setup = configparser.ConfigParser()
setup.read("setup.cfg")
print(setup["options"]["install_requires"].strip())')
  pip install --quiet --only-binary :all: --python-version "$version" --target "$folder" \
    "${requires[@]}" pytest scipy hypothesis gmpy2
  # Their own tests, a quarter of the bytes, are not needed.
  find "$folder" -type d \( -name tests -o -name __pycache__ \) -prune -exec rm -r {} +
  tar -C "$folder" -cJf "$archive" .
  du -h "$archive"
  ;;
run)
  python3 -m tarfile -e "$archive" "$folder"
  PYTHONPATH=$PWD:$folder python3 bench/bench_device.py "${@:2}"
  ;;
*)
  echo "bench/carry.sh pack or run, not '$what'" >&2
  exit 2
  ;;
esac
