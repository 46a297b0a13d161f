#!/usr/bin/env bash
# A folder with Gazebo classic 11 and the lock-step program, from the packages of Debian 11 (bullseye), on a Debian
# that has no such packages of its own. Needs root, debootstrap and 3 GB; a folder that is complete is kept.
#
#   bridges/gazebo_classic/setup.sh FOLDER
#   export FMU_MESH_GAZEBO="chroot FOLDER /opt/fmu_mesh/gazebo_lockstep"
#
# Packages come from where this system has its own from, or from $MIRROR.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
folder=${1:?"usage: $0 FOLDER"}
[[ $(id -u) -eq 0 ]] || { echo "only root can make a system in a folder" >&2; exit 1; }

if [[ ! -d $folder ]]; then
  command -v debootstrap >/dev/null || { echo "there is no debootstrap (apt-get install debootstrap)" >&2; exit 1; }
  mirror=${MIRROR:-$(apt-get indextargets --format '$(SITE)' 'Created-By: Packages' | grep '/debian/*$' | sort -u |
    head -n 1 || true)}
  [[ -n $mirror ]] || { echo "this system has no Debian mirror; set MIRROR" >&2; exit 1; }
  draft=$folder.draft
  rm -rf "$draft"
  mkdir -p "$draft"
  debootstrap --variant=minbase bullseye "$draft" "$mirror"
  # No services in there, and the names that Gazebo looks up.
  printf '#!/bin/sh\nexit 101\n' >"$draft/usr/sbin/policy-rc.d"
  chmod +x "$draft/usr/sbin/policy-rc.d"
  cp /etc/hosts "$draft/etc/hosts"
  DEBIAN_FRONTEND=noninteractive LC_ALL=C chroot "$draft" apt-get install --yes --no-install-recommends \
    -o Dpkg::Options::=--force-unsafe-io libgazebo-dev g++ make pkg-config
  chroot "$draft" apt-get clean
  mv "$draft" "$folder"
fi
mkdir -p "$folder/opt/fmu_mesh"
cp --preserve=timestamps "$here/gazebo_lockstep.cc" "$here/Makefile" "$folder/opt/fmu_mesh/"
LC_ALL=C chroot "$folder" make --silent --directory /opt/fmu_mesh CXXFLAGS="-O2 -w"
