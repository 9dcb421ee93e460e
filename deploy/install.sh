#!/bin/sh
# Installs or upgrades BirdSLAM as a systemd service; keeps the configuration.
#
#   sudo deploy/install.sh                       install or upgrade, from this checkout or folder of `birdslam deploy`
#   sudo deploy/install.sh uninstall [--purge]   remove it; --purge: configuration, certificates, results and user too
#
# PYTHON (default /usr/bin/python3, 3.11 or newer) creates the virtual environment. BIRDSLAM_PACKAGE, a wheel or a
# requirement for pip, replaces the checkout or the package that `birdslam deploy` pinned. The variables of pip
# (PIP_INDEX_URL, PIP_FIND_LINKS, ...) apply. The script can run repeatedly.
set -eu

prefix=/opt/birdslam
etc=/etc/birdslam
units=/etc/systemd/system
services="birdslam.service birdslam-gate.service birdslam-uplink.service birdslam-router.service birdslam-ros.service"
source=$(cd "$(dirname "$0")/.." && pwd)
python=${PYTHON:-/usr/bin/python3}

say() { echo "birdslam: $*"; }

fail() {
    echo "install.sh: $*" >&2
    exit 2
}

systemd_runs() { [ -d /run/systemd/system ]; }

check() {
    command -v systemd-sysusers >/dev/null || fail "systemd is missing: apt-get install systemd"
    "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null ||
        fail "$python is not Python 3.11 or newer; set PYTHON=..."
    "$python" -c 'import ensurepip' 2>/dev/null || fail "$python has no venv module: apt-get install python3-venv"
    path=$("$python" -c 'import os, sys; print(os.path.realpath(sys.executable).lstrip("/"))')
    case ${path%%/*} in
    home | root) fail "$python is in a home directory, which the service can't access; set PYTHON=..." ;;
    esac
}

# Each release is a directory and `current` points to one, so that a failed upgrade changes nothing.
new_release() {
    mkdir -p "$prefix/releases"
    chmod 755 "$prefix" "$prefix/releases"
    release=$(mktemp -d "$prefix/releases/$(date -u +%Y%m%d-%H%M%S)-XXXX")
    chmod 755 "$release"
    trap 'rm -rf "$release"' EXIT
    "$python" -m venv "$release"
    if [ -n "${BIRDSLAM_PACKAGE:-}" ]; then
        package=$BIRDSLAM_PACKAGE
    elif [ -f "$source/package" ]; then
        package=$(cat "$source/package")
    else # built from a copy, to leave no files of root in the checkout
        package=$release/source
        mkdir "$package"
        (cd "$source" && cp -R pyproject.toml setup.py README.md LICENSE birdslam runtime deploy configs "$package")
    fi
    "$release/bin/python" -m pip install --quiet --disable-pip-version-check "$package"
    rm -rf "$release/source"
    "$release/bin/birdslam" --version
    cp -R "$source/deploy" "$release/deploy" # certificates.sh, and this script for uninstall
    trap - EXIT
    previous=$(readlink "$prefix/current" || true)
    ln -s "$release" "$prefix/current.new"
    mv -T "$prefix/current.new" "$prefix/current"
    for old in "$prefix"/releases/*; do # keep one release for a rollback
        [ "$old" = "$release" ] || [ "$old" = "$previous" ] || rm -rf "$old"
    done
}

keep_or_copy() { # FILE TARGET: keeps an existing target and writes a different version to TARGET.new
    if [ ! -e "$2" ]; then
        install -m 644 "$1" "$2"
    elif cmp -s "$1" "$2"; then
        rm -f "$2.new"
    else
        install -m 644 "$1" "$2.new"
        say "$2 is kept; the version of this release is $2.new"
    fi
}

configuration() {
    install -d -m 755 "$etc"
    template=$(mktemp)
    grep -v '^output = ' "$source/configs/vehicle.toml" >"$template" # the unit sets the output directory
    keep_or_copy "$template" "$etc/vehicle.toml"
    rm -f "$template"
    keep_or_copy "$source/deploy/gate.json5" "$etc/gate.json5"
}

install_or_upgrade() {
    check
    new_release
    install -D -m 644 "$source/deploy/birdslam.sysusers" /usr/lib/sysusers.d/birdslam.conf
    systemd-sysusers /usr/lib/sysusers.d/birdslam.conf
    configuration
    for unit in $services; do
        install -D -m 644 "$source/deploy/$unit" "$units/$unit"
    done
    if systemd_runs; then
        systemctl daemon-reload
        systemctl enable --quiet birdslam.service
        for unit in $services; do
            systemctl try-restart "$unit"
        done
    else
        say "systemd is not running: the service is not enabled"
    fi
    say "installed in $prefix; configure $etc/vehicle.toml, then: systemctl start birdslam"
}

uninstall() {
    if systemd_runs; then
        for unit in $services; do
            [ ! -e "$units/$unit" ] || systemctl disable --quiet --now "$unit"
        done
    fi
    for unit in $services; do
        rm -f "$units/$unit"
    done
    rm -f /usr/lib/sysusers.d/birdslam.conf
    rm -rf "$prefix" /var/cache/birdslam
    ! systemd_runs || systemctl daemon-reload
    if [ "${1:-}" = --purge ]; then
        rm -rf "$etc" /var/lib/birdslam "$units"/birdslam.service.d "$units"/birdslam-*.service.d
        ! getent passwd birdslam >/dev/null || userdel birdslam
        ! getent group birdslam >/dev/null || groupdel birdslam
        say "removed, with its configuration, results and user"
    else
        say "removed; $etc and /var/lib/birdslam are kept (uninstall --purge removes them too)"
    fi
}

[ "$(id -u)" = 0 ] || fail "needs root"
umask 022
case ${1:-install} in
install | upgrade) install_or_upgrade ;;
uninstall) uninstall "${2:-}" ;;
*) fail "$1: expected install, upgrade or uninstall [--purge]" ;;
esac
