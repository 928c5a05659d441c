//! Transports of a controller without shared memory: a Unix stream socket, or UDP over loopback.

use std::io::{ErrorKind, Read, Write};
use std::net::UdpSocket;
use std::os::unix::net::{UnixListener, UnixStream};
use std::time::Instant;

use ipc_types::messages::layout::Message;
use ipc_types::messages::{Command, State};
use ipc_types::process::bind_to_parent;

use super::super::failed;
use super::super::ping_pong::Wait;
use super::super::samples::Samples;
use super::Peer;
use super::cores::Cores;
use super::peers::echo_command;
use trabecula::failure::Failure;

enum Socket {
    Unix(UnixStream),
    Udp(UdpSocket),
}

impl Socket {
    fn set_wait(&self, wait: Wait) -> std::io::Result<()> {
        let spins = wait == Wait::Spin;
        match self {
            Socket::Unix(stream) => stream.set_nonblocking(spins),
            Socket::Udp(socket) => socket.set_nonblocking(spins),
        }
    }

    fn send(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        let mut rest = bytes;
        while !rest.is_empty() {
            let sent = match self {
                Socket::Unix(stream) => stream.write(rest),
                Socket::Udp(socket) => socket.send(rest),
            };
            match sent {
                Ok(count) => rest = &rest[count..],
                Err(cause) if cause.kind() == ErrorKind::WouldBlock => std::hint::spin_loop(),
                Err(cause) => return Err(cause),
            }
        }
        Ok(())
    }

    fn receive(&mut self, bytes: &mut [u8]) -> std::io::Result<()> {
        let mut filled = 0;
        while filled < bytes.len() {
            let room = &mut bytes[filled..];
            let came = match self {
                Socket::Unix(stream) => stream.read(room),
                Socket::Udp(socket) => socket.recv(room),
            };
            match came {
                Ok(0) => return Err(ErrorKind::UnexpectedEof.into()),
                Ok(count) => filled += count,
                Err(cause) if cause.kind() == ErrorKind::WouldBlock => std::hint::spin_loop(),
                Err(cause) => return Err(cause),
            }
        }
        Ok(())
    }
}

/// Measures round trips with this program in a separate process.
///
/// # Errors
/// Any system error.
pub(super) fn measure(peer: Peer, wait: Wait, rounds: usize, cores: Cores) -> Result<Samples, Failure> {
    let folder = tempfile::tempdir().map_err(failed)?;
    let path = folder.path().join("socket");
    let udp = UdpSocket::bind("127.0.0.1:0").map_err(failed)?;
    let listener = UnixListener::bind(&path).map_err(failed)?;
    let address = match peer {
        Peer::Udp => udp.local_addr().map_err(failed)?.to_string(),
        _ => path.display().to_string(),
    };
    let mut command = echo_command(peer, wait, rounds, &address)?;
    let mut child = cores.apart(|| bind_to_parent(&mut command).spawn().map_err(failed))?;
    let socket = if peer == Peer::Udp {
        // The other side's first datagram contains its address.
        let (_, from) = udp.recv_from(&mut [0]).map_err(failed)?;
        udp.connect(from).map_err(failed)?;
        Socket::Udp(udp)
    } else {
        Socket::Unix(listener.accept().map_err(failed)?.0)
    };
    let samples = play(socket, wait, rounds).map_err(failed);
    if samples.is_err() {
        // It may already have ended.
        let _ = child.kill();
    }
    child.wait().map_err(failed)?;
    samples
}

fn play(mut socket: Socket, wait: Wait, rounds: usize) -> std::io::Result<Samples> {
    socket.set_wait(wait)?;
    let mut samples = Samples::default();
    let state = vec![1_u8; State::DESCRIPTION.size];
    let mut command = vec![0_u8; Command::DESCRIPTION.size];
    for _ in 0..rounds {
        let began = Instant::now();
        socket.send(&state)?;
        socket.receive(&mut command)?;
        samples.add(began.elapsed().as_nanos() as u64);
    }
    Ok(samples)
}

/// Runs the answering side.
///
/// # Errors
/// Any system error.
pub(super) fn answer(peer: Peer, wait: Wait, rounds: usize, address: &str) -> Result<(), Failure> {
    let mut socket = if peer == Peer::Udp {
        let udp = UdpSocket::bind("127.0.0.1:0").map_err(failed)?;
        udp.connect(address).map_err(failed)?;
        udp.send(&[1]).map_err(failed)?;
        Socket::Udp(udp)
    } else {
        Socket::Unix(UnixStream::connect(address).map_err(failed)?)
    };
    socket.set_wait(wait).map_err(failed)?;
    let mut state = vec![0_u8; State::DESCRIPTION.size];
    let command = vec![1_u8; Command::DESCRIPTION.size];
    for _ in 0..rounds {
        socket.receive(&mut state).map_err(failed)?;
        socket.send(&command).map_err(failed)?;
    }
    Ok(())
}
