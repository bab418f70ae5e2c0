"""Where the labelling page listens: an address of this machine that is meant, and no other."""

import ipaddress
import socket


def address_of(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    """The one address that a host stands for: one of this machine's own loopback, or one that is spelled out.

    Raises:
        OSError: the name is not known.
        ValueError: all interfaces, however they are spelled, or a name or spelling of an address beyond loopback.
    """
    try:
        resolved = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0][4][0] if host else "::"
    except (OSError, UnicodeError) as e:
        raise OSError(
            f"cannot listen on {host!r} ({e}); keep --host=127.0.0.1, or give an address of this machine"
        ) from e
    address = ipaddress.ip_address(resolved)
    address = getattr(address, "ipv4_mapped", None) or address
    if address.is_unspecified or address.is_multicast:
        raise ValueError(
            f"--host={host} would take calls under any name; keep 127.0.0.1 and use an SSH tunnel, or give the one "
            "address by which your browser reaches this machine"
        )
    if not address.is_loopback and str(address) != host.lower():
        raise ValueError(
            f"--host={host} stands for {address}, which others can reach; keep 127.0.0.1 and use an SSH tunnel, or "
            f"give --host={address} if you mean it"
        )
    return address


def listen(host: str, port: int) -> socket.socket:
    """A bound socket, on exactly the address that `address_of` finds.

    Raises:
        OSError: the port is in use or the address is not this machine's.
        ValueError: an address that names no interface, or more than it says.
    """
    address = address_of(host)
    listener = socket.socket(socket.AF_INET6 if address.version == 6 else socket.AF_INET)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((str(address), port))
        listener.listen()
    except (OSError, OverflowError) as e:
        listener.close()
        raise OSError(f"cannot listen on {host} port {port} ({e}); choose another --port (0 takes a free one)") from e
    return listener
