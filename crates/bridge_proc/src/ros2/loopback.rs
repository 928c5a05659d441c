//! Restricts DDS to this machine. DDS binds its unicast sockets to every address, whatever networks it
//! announces, so datagrams from elsewhere would be read. A socket bound to the device `lo` receives nothing
//! else from the kernel, and sends nothing else.

use std::os::fd::OwnedFd;

use rustix::process::{PidfdFlags, PidfdGetfdFlags, getpid, pidfd_getfd, pidfd_open};
use socket2::{Domain, SockRef, Type};

/// Binds every UDP socket of this process to the loopback device. Since Linux 5.7 any process may do that.
///
/// # Errors
/// The kernel's error: an older kernel, or a container whose seccomp profile forbids `pidfd_getfd`.
pub(crate) fn close_to_others() -> std::io::Result<usize> {
    // Get a second descriptor of the same socket: options belong to the socket, whichever descriptor sets
    // them.
    let myself = pidfd_open(getpid(), PidfdFlags::empty())?;
    let mut bound = 0;
    for entry in std::fs::read_dir("/proc/self/fd")? {
        let name = entry?.file_name();
        let Some(number) = name.to_str().and_then(|name| name.parse().ok()) else { continue };
        let link = std::fs::read_link(format!("/proc/self/fd/{number}"));
        if !link.is_ok_and(|link| link.to_string_lossy().starts_with("socket:")) {
            continue;
        }
        let descriptor: OwnedFd = pidfd_getfd(&myself, number, PidfdGetfdFlags::empty())?;
        let socket = SockRef::from(&descriptor);
        let is_udp =
            socket.r#type()? == Type::DGRAM && matches!(socket.domain()?, Domain::IPV4 | Domain::IPV6);
        if is_udp {
            socket.bind_device(Some(b"lo"))?;
            bound += 1;
        }
    }
    Ok(bound)
}

#[cfg(test)]
mod tests {
    use std::net::UdpSocket;

    use super::*;

    #[test]
    fn a_bound_socket_hears_this_machine() {
        let socket = UdpSocket::bind("0.0.0.0:0").unwrap();
        match close_to_others() {
            Ok(bound) => assert!(bound >= 1),
            Err(reason) => return println!("not here: {reason}"),
        }
        assert_eq!(SockRef::from(&socket).device().unwrap().as_deref(), Some(b"lo".as_slice()));
        let port = socket.local_addr().unwrap().port();
        UdpSocket::bind("127.0.0.1:0").unwrap().send_to(b"x", ("127.0.0.1", port)).unwrap();
        socket.set_read_timeout(Some(std::time::Duration::from_secs(10))).unwrap();
        assert_eq!(socket.recv(&mut [0; 8]).unwrap(), 1);
    }
}
