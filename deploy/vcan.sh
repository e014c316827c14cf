#!/bin/sh
# Makes virtual CAN buses that carry CAN FD: vcan.sh [CHANNEL ...], vcan0 if none is named.
# Says what it did; an existing channel is brought up as asked and otherwise left alone.
set -eu

fail() {
    echo "vcan.sh: $*" >&2
    exit 1
}

[ $# -gt 0 ] || set -- vcan0
case $1 in -*) fail "there is no option '$1'; usage: vcan.sh [CHANNEL ...]" ;; esac
command -v ip >/dev/null || fail "the command 'ip' was not found; install the package iproute2"
[ "$(id -u)" = 0 ] || fail "making a network interface needs root; run: sudo $0 $*"
modprobe vcan 2>/dev/null || true # absent where it is built in; the next command tells

for channel; do
    if ! ip link show dev "$channel" >/dev/null 2>&1; then
        reason=$(ip link add dev "$channel" type vcan 2>&1) ||
            fail "cannot make $channel ($reason); this kernel ($(uname -r)) has no vcan driver:" \
                "install the package of its extra modules, or use --can-interface eqrt_local"
    elif [ -z "$(ip link show dev "$channel" type vcan)" ]; then
        fail "$channel is there and is not a virtual CAN interface; name another channel"
    fi
    case $(ip link show dev "$channel") in
    *" mtu 72 "*) ;;
    *)
        ip link set down dev "$channel" # the kernel refuses a change while the channel is up
        ip link set mtu 72 dev "$channel" # the size of one CAN FD message
        ;;
    esac
    ip link set up dev "$channel"
    echo "$channel is up (CAN FD)"
done
