#!/bin/sh
# Creates the certificates of the gate: an authority, the vehicle, each planner and the car. Creates the certificates of
# a fleet in another directory, with another authority: the router, each vehicle and each listener.
#
#   certificates.sh DIR vehicle ADDRESS...   ca.pem, vehicle.pem, vehicle.key; ADDRESS: names and IPs planners connect to
#   certificates.sh DIR planner NAME         NAME.pem, NAME.key; add NAME to gate.json5 (cert_common_names)
#   certificates.sh DIR car                  car.pem, car.key: the computer that publishes the speed of the car
#   certificates.sh DIR router ADDRESS...    router.pem, router.key; ADDRESS: names and IPs that vehicles connect to
#   certificates.sh DIR uplink NAME          NAME.vehicle.pem, NAME.vehicle.key: the vehicle NAME of a fleet
#   certificates.sh DIR planner NAME         a listener of a fleet; add NAME to [router] (listeners)
#
# Existing files are kept; remove a file to create it again. Whoever has ca.key can sign certificates that the vehicle
# accepts: keep it on another computer.
set -eu
umask 077
days=${BIRDSLAM_CERTIFICATE_DAYS:-825}

fail() {
    echo "certificates.sh: $*" >&2
    exit 2
}

new_key() { # arguments of openssl req
    openssl req -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes "$@" 2>"$work/openssl" || fail "$(cat "$work/openssl")"
}

authority() {
    [ ! -e "$dir/ca.pem" ] || return 0
    new_key -x509 -keyout "$work/ca.key" -out "$work/ca.pem" -days "$days" -subj "/CN=BirdSLAM authority" \
        -addext basicConstraints=critical,CA:TRUE,pathlen:0 -addext keyUsage=critical,keyCertSign,cRLSign
    mv "$work/ca.key" "$work/ca.pem" "$dir"
}

certificate() { # FILE COMMON_NAME ALTERNATIVE_NAMES USAGE
    if [ -e "$dir/$1.pem" ]; then
        echo "$dir/$1.pem is kept"
        return 0
    fi
    [ -e "$dir/ca.key" ] || fail "$dir/ca.key is missing; copy the key of the authority here to sign"
    new_key -keyout "$work/$1.key" -out "$work/csr" -subj "/CN=$2"
    printf '%s\n' basicConstraints=critical,CA:FALSE keyUsage=critical,digitalSignature \
        "extendedKeyUsage=$4" "subjectAltName=$3" >"$work/extensions"
    openssl x509 -req -in "$work/csr" -CA "$dir/ca.pem" -CAkey "$dir/ca.key" -set_serial "0x$(openssl rand -hex 16)" \
        -days "$days" -extfile "$work/extensions" -out "$work/$1.pem" 2>"$work/openssl" || fail "$(cat "$work/openssl")"
    mv "$work/$1.key" "$work/$1.pem" "$dir"
    echo "created $dir/$1.pem and $dir/$1.key"
}

[ $# -ge 3 ] || [ "${2-}" = car ] ||
    fail "usage: certificates.sh DIR vehicle|router ADDRESS... | certificates.sh DIR planner|uplink NAME | certificates.sh DIR car"
dir=$1 what=$2
shift 2
mkdir -p "$dir"
work=$(mktemp -d "$dir/.new.XXXXXX")
trap 'rm -rf "$work"' EXIT

case $what in
vehicle | router)
    names=
    for address in "$@"; do
        case $address in
        *[!A-Za-z0-9.:-]*) fail "$address is not a host name or an IP address" ;;
        *:*) kind=IP ;;
        *[!0-9.]*) kind=DNS ;;
        *) kind=IP ;;
        esac
        names="$names${names:+,}$kind:$address"
    done
    authority
    certificate "$what" "$what" "$names" serverAuth
    ;;
planner)
    case $1 in
    *[!A-Za-z0-9_-]* | ca | vehicle | router | car) fail "$1: the name of a planner has letters, digits, '_' and '-', and is not ca, vehicle, router or car" ;;
    esac
    authority
    certificate "$1" "$1" "DNS:$1" clientAuth
    ;;
uplink)
    case $1 in
    *[!A-Za-z0-9_-]* | [_-]* | "") fail "$1: the name of a vehicle has letters, digits, '_' and '-', and starts with a letter or a digit" ;;
    esac
    [ ${#1} -le 32 ] || fail "$1: the name of a vehicle has at most 32 characters"
    authority
    certificate "$1.vehicle" "vehicle $1" "DNS:$1" clientAuth # the blank distinguishes it from planners
    ;;
car)
    authority
    certificate car "the car" "DNS:car" clientAuth # the blank distinguishes it from planners
    ;;
*) fail "$what: expected vehicle, planner, car, router or uplink" ;;
esac

chmod 644 "$dir"/*.pem
# The user of the service can read only the key of the gate or the router.
for key in vehicle.key router.key; do
    if [ "$(id -u)" = 0 ] && getent group birdslam >/dev/null && [ -e "$dir/$key" ]; then
        chgrp birdslam "$dir" "$dir/$key"
        chmod 750 "$dir"
        chmod 640 "$dir/$key"
    fi
done
