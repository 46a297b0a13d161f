#!/usr/bin/env bash
# A folder with Gazebo classic 11 and the lock-step program, from the packages of Debian 11 (bullseye), on a Debian or Ubuntu
# that has no such packages of its own. Needs root, debootstrap and about 3 GB; a folder that is complete is kept.
#
#   bridges/gazebo_classic/setup.sh FOLDER
#   export FMU_MESH_GAZEBO="chroot FOLDER /opt/fmu_mesh/gazebo_lockstep"
#
# Packages come from where this system has its own from, or from $MIRROR.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
folder=${1:?"usage: $0 FOLDER"}
mirror=${MIRROR:-$(apt-get indextargets --format '$(SITE)' 'Created-By: Packages' | grep '/debian/*$' | sort -u | head -n 1)}

if [[ ! -e $folder/.complete ]]; then
  [[ -n $mirror ]] || { echo "no Debian mirror found; set MIRROR" >&2; exit 1; }
  debootstrap --variant=minbase bullseye "$folder" "$mirror"
  # No services in there, and names that Gazebo looks up.
  printf '#!/bin/sh\nexit 101\n' >"$folder/usr/sbin/policy-rc.d"
  chmod +x "$folder/usr/sbin/policy-rc.d"
  cp /etc/hosts "$folder/etc/hosts"
  DEBIAN_FRONTEND=noninteractive LC_ALL=C chroot "$folder" apt-get install --yes --no-install-recommends \
    -o Dpkg::Options::=--force-unsafe-io libgazebo-dev g++ make pkg-config
  chroot "$folder" apt-get clean
  touch "$folder/.complete"
fi
mkdir -p "$folder/opt/fmu_mesh"
cp "$here/gazebo_lockstep.cc" "$here/Makefile" "$folder/opt/fmu_mesh/"
LC_ALL=C chroot "$folder" make --silent --directory /opt/fmu_mesh CXXFLAGS="-O2 -w"
