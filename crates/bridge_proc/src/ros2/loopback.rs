//! Restricts DDS to this machine, whatever networks it announces. DDS binds its sockets to every address. A
//! filter in the kernel drops every datagram whose source is not an address of this machine, before DDS can
//! read it; the kernel itself drops datagrams that come from outside with such a source ("martians"). With a
//! multicast TTL of 0, announcements do not leave the machine.
//!
//! Sockets bound to the device `lo` are not enough: Cyclone DDS with its default configuration uses the first
//! network, and ignores participants that announce loopback addresses only.

use std::net::{IpAddr, Ipv4Addr, UdpSocket};
use std::os::fd::OwnedFd;

use rustix::process::{PidfdFlags, PidfdGetfdFlags, getpid, pidfd_getfd, pidfd_open};
use socket2::{Domain, SockFilter, SockRef, Type};

/// Number of addresses that a filter has room for: its jumps are bytes.
const ADDRESS_COUNT: usize = 60;

/// Returns the IPv4 addresses of this machine, that of loopback first.
fn own_addresses() -> Vec<Ipv4Addr> {
    let others = netdev::get_interfaces().into_iter().flat_map(|interface| interface.ipv4);
    let others = others.map(|net| net.addr()).filter(|address| !address.is_loopback());
    core::iter::once(Ipv4Addr::LOCALHOST).chain(others).take(ADDRESS_COUNT).collect()
}

/// How DDS is restricted.
#[derive(Debug)]
pub(crate) struct Loopback {
    filter: Vec<SockFilter>,
    addresses: Vec<Ipv4Addr>,
}

impl Loopback {
    /// Prepares the restriction; `None` if the operating system does not allow it: an older kernel than 5.6,
    /// or a container whose seccomp profile forbids `pidfd_getfd`.
    pub(crate) fn prepare() -> Option<Loopback> {
        let addresses = own_addresses();
        let restriction = Loopback { filter: filter(&addresses), addresses };
        // Something to try it on.
        let probe = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).ok()?;
        let works = restriction.close_to_others().is_ok();
        drop(probe);
        works.then_some(restriction)
    }

    /// The addresses that DDS may announce.
    pub(crate) fn addresses(&self) -> impl Iterator<Item = IpAddr> + '_ {
        self.addresses.iter().map(|address| IpAddr::V4(*address))
    }

    /// Restricts every UDP socket of this process; returns their number.
    ///
    /// # Errors
    /// The kernel's error.
    pub(crate) fn close_to_others(&self) -> std::io::Result<usize> {
        // Get a second descriptor of the same socket: options belong to the socket, whichever descriptor sets
        // them.
        let myself = pidfd_open(getpid(), PidfdFlags::empty())?;
        let mut closed = 0;
        for entry in std::fs::read_dir("/proc/self/fd")? {
            let name = entry?.file_name();
            let Some(number) = name.to_str().and_then(|name| name.parse().ok()) else { continue };
            let link = std::fs::read_link(format!("/proc/self/fd/{number}"));
            if !link.is_ok_and(|link| link.to_string_lossy().starts_with("socket:")) {
                continue;
            }
            let descriptor: OwnedFd = pidfd_getfd(&myself, number, PidfdGetfdFlags::empty())?;
            let socket = SockRef::from(&descriptor);
            if socket.r#type()? != Type::DGRAM {
                continue;
            }
            match socket.domain()? {
                Domain::IPV4 => socket.set_multicast_ttl_v4(0)?,
                Domain::IPV6 => socket.set_multicast_hops_v6(0)?,
                _ => continue,
            }
            socket.attach_filter(&self.filter)?;
            closed += 1;
        }
        Ok(closed)
    }
}

/// Returns a classic BPF program (socket(7), `SO_ATTACH_FILTER`) that accepts IPv4 datagrams whose source
/// is one of these. Of loopback only 127.0.0.1 is safe: with `route_localnet` the kernel lets datagrams
/// with another source of 127/8 in from outside.
fn filter(sources: &[Ipv4Addr]) -> Vec<SockFilter> {
    // BPF_LD | BPF_ABS with BPF_W and BPF_B, BPF_ALU | BPF_RSH, BPF_JMP | BPF_JEQ, BPF_RET, all with BPF_K:
    // linux/bpf_common.h.
    const WORD: u16 = 0x20;
    const BYTE: u16 = 0x30;
    const SHIFT: u16 = 0x74;
    const IF_EQUAL: u16 = 0x15;
    const RETURN: u16 = 0x06;
    /// `SKF_NET_OFF`: offsets from the IP header.
    const IP_HEADER: u32 = 0xfff0_0000;
    let plain = |code, value| SockFilter::new(code, 0, 0, value);
    let count = sources.len().min(ADDRESS_COUNT) as u8;
    let mut program =
        vec![plain(BYTE, IP_HEADER), plain(SHIFT, 4), SockFilter::new(IF_EQUAL, 0, count + 1, 4)];
    program.push(plain(WORD, IP_HEADER + 12));
    for (number, address) in (0..count).zip(sources) {
        // To the last instruction.
        program.push(SockFilter::new(IF_EQUAL, count - number, 0, u32::from(*address)));
    }
    program.push(plain(RETURN, 0));
    program.push(plain(RETURN, u32::MAX));
    program
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    /// Returns the datagrams that a socket has received.
    fn received(socket: &UdpSocket) -> Vec<u8> {
        socket.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        let mut all = Vec::new();
        let mut buffer = [0; 8];
        while let Ok(1) = socket.recv(&mut buffer) {
            all.push(buffer[0]);
            if buffer[0] == b'.' {
                break;
            }
        }
        all
    }

    /// Other addresses of loopback stand for other machines. Datagrams on loopback arrive in order.
    #[test]
    fn a_filter_drops_what_comes_from_other_addresses() {
        let from = |last: u8| UdpSocket::bind((Ipv4Addr::new(127, 0, 0, last), 0)).unwrap();
        for (sources, expected) in [
            (vec![Ipv4Addr::LOCALHOST], "a."),
            (vec![Ipv4Addr::new(10, 0, 0, 1), Ipv4Addr::LOCALHOST], "a."),
            (vec![Ipv4Addr::LOCALHOST, Ipv4Addr::new(127, 0, 0, 2)], "ab."),
            (vec![Ipv4Addr::new(127, 0, 0, 3), Ipv4Addr::LOCALHOST, Ipv4Addr::new(127, 0, 0, 2)], "abc."),
        ] {
            let socket = UdpSocket::bind("0.0.0.0:0").unwrap();
            SockRef::from(&socket).attach_filter(&filter(&sources)).unwrap();
            let port = socket.local_addr().unwrap().port();
            for (last, text) in [(1, b"a"), (2, b"b"), (3, b"c"), (1, b".")] {
                from(last).send_to(text, (Ipv4Addr::LOCALHOST, port)).unwrap();
            }
            assert_eq!(received(&socket), expected.as_bytes(), "{sources:?}");
        }
    }

    #[test]
    fn every_socket_of_the_process_hears_this_machine_at_each_of_its_addresses() {
        let socket = UdpSocket::bind("0.0.0.0:0").unwrap();
        let Some(loopback) = Loopback::prepare() else { return println!("not possible here") };
        assert!(loopback.close_to_others().unwrap() >= 1);
        assert_eq!(SockRef::from(&socket).multicast_ttl_v4().unwrap(), 0);
        let port = socket.local_addr().unwrap().port();
        for address in loopback.addresses() {
            UdpSocket::bind((address, 0)).unwrap().send_to(b".", (address, port)).unwrap();
            assert_eq!(received(&socket), b".", "{address}");
        }
    }
}
