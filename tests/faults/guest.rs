//! The external controller in a separate process, well behaved or not.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command as Program, Stdio};
use std::time::Duration;

use fastrand::Rng;
use ipc_types::messages::services;
use ipc_types::messages::{Command, DrrRequest, Event, Progress, RunControl, State};
use ipc_types::session::{Reader, SESSION_VARIABLE, Session, SessionError};
use rustix::process::Signal;
use trabecula_client::{Client, Connection};
use zerocopy::IntoBytes;

use crate::common::client::{bare_port, send_bare};
use crate::common::program::{signal, wait_for};

const BEHAVIOUR: &str = "TRABECULA_TEST_GUEST";
const NAME: &str = "TRABECULA_TEST_GUEST_NAME";
const SEED: &str = "TRABECULA_TEST_GUEST_SEED";
/// Printed by the guest once it is running.
const READY: &str = "guest is ready";
const LIMIT: Duration = Duration::from_secs(20);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Behaviour {
    Steady,
    Slow,
    Flood,
    Garbage,
    Loan,
    OtherVersion,
}

impl Behaviour {
    const ALL: [Behaviour; 6] = [
        Behaviour::Steady,
        Behaviour::Slow,
        Behaviour::Flood,
        Behaviour::Garbage,
        Behaviour::Loan,
        Behaviour::OtherVersion,
    ];

    /// Returns a behaviour that disturbs others.
    pub fn bad(random: &mut Rng) -> Behaviour {
        [Behaviour::Slow, Behaviour::Flood, Behaviour::Garbage, Behaviour::Loan][random.u64(..4) as usize]
    }
}

/// A running guest; it is killed when dropped.
#[derive(Debug)]
pub struct Guest {
    child: Child,
    lines: Option<BufReader<std::process::ChildStdout>>,
}

impl Guest {
    pub fn start(session: &Path, name: &str, behaviour: Behaviour, seed: u64) -> Guest {
        Guest::of(Program::new(std::env::current_exe().unwrap()), session, name, behaviour, seed)
    }

    /// The same, started by a program that takes the guest's command line as its arguments.
    pub fn of(mut program: Program, session: &Path, name: &str, behaviour: Behaviour, seed: u64) -> Guest {
        program.args(["--exact", "guest::guest_program", "--nocapture"]);
        program.env(SESSION_VARIABLE, session).env(NAME, name).env(SEED, seed.to_string());
        program.env(BEHAVIOUR, format!("{behaviour:?}"));
        let mut child =
            program.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
        let lines = child.stdout.take().map(BufReader::new);
        Guest { child, lines }
    }

    /// Waits until it is running; the error is what it printed instead.
    pub fn ready(&mut self) -> Result<(), String> {
        let mut said = String::new();
        for line in self.lines.take().unwrap().lines().map_while(Result::ok) {
            if line.contains(READY) {
                return Ok(());
            }
            said += &line;
            said += "\n";
        }
        Err(said)
    }

    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    pub fn kill(&mut self) {
        signal(self.pid(), Signal::KILL);
        let _ = self.child.wait();
    }
}

impl Drop for Guest {
    fn drop(&mut self) {
        self.kill();
    }
}

/// Not a test by itself: the guest's program, which [`Guest`] starts from this test's own file.
#[test]
fn guest_program() {
    let Ok(behaviour) = std::env::var(BEHAVIOUR) else { return };
    let behaviour = Behaviour::ALL.into_iter().find(|known| format!("{known:?}") == behaviour).unwrap();
    let session = PathBuf::from(std::env::var_os(SESSION_VARIABLE).unwrap());
    let name = std::env::var(NAME).unwrap();
    let seed = std::env::var(SEED).unwrap().parse().unwrap();
    let said = match behaviour {
        Behaviour::Garbage => garbage(&session, &name, seed).map_err(|error| error.to_string()),
        Behaviour::OtherVersion => other_version(&session),
        Behaviour::Loan => loan(&session, &name).map_err(|error| error.to_string()),
        other => controller(&session, &name, other).map_err(|error| error.to_string()),
    };
    println!("guest ends: {said:?}");
}

fn controller(session: &Path, name: &str, behaviour: Behaviour) -> Result<(), trabecula_client::ClientError> {
    let mut client = Client::connect(&Connection {
        session: Some(session.to_str().unwrap().to_owned()),
        controller: Some(name.to_owned()),
        limit: LIMIT,
    })?;
    client.wait_state(LIMIT)?;
    client.command()?;
    client.send()?;
    println!("\n{READY}");
    loop {
        match behaviour {
            Behaviour::Flood => {
                client.poll_state()?;
                for _ in 0..2000 {
                    client.command()?;
                    client.send()?;
                }
            }
            _ => {
                if behaviour == Behaviour::Slow {
                    std::thread::sleep(Duration::from_millis(100));
                }
                // A stopped hub is silent for a while.
                match client.answer(LIMIT, |_, _| {}) {
                    Err(trabecula_client::ClientError::TimedOut(_)) | Ok(()) => {}
                    Err(other) => return Err(other),
                }
            }
        }
    }
}

/// Answers a state, and then keeps a loan in shared memory for a command that it never sends. Bypasses the
/// library, which keeps a loan only while it sends.
fn loan(folder: &Path, name: &str) -> Result<(), Box<dyn std::error::Error>> {
    let session = Session::join(folder)?;
    let states = session.subscriber::<State>(&services::STATE)?;
    let state_tick = wait_for("a state", || states.receive().unwrap().map(|state| state.message().tick));
    let service = session.node().service_builder(&services::command_name(name).as_str().try_into()?);
    let service = service.publish_subscribe::<[u8]>().open()?;
    let publisher = service.publisher_builder().initial_max_slice_len(size_of::<Command>()).create()?;
    let command = Command { sequence: 1, state_tick, ..Command::zeroed() };
    publisher.loan_slice_uninit(size_of::<Command>())?.write_from_slice(command.as_bytes()).send()?;
    session.waker(Reader::Physics)?.wake();
    let _held = publisher.loan_slice_uninit(size_of::<Command>())?;
    println!("\n{READY}");
    std::thread::sleep(LIMIT);
    Ok(())
}

/// Sends random bytes to every service that a client may write.
fn garbage(folder: &Path, name: &str, seed: u64) -> Result<(), Box<dyn std::error::Error>> {
    let session = Session::join(folder)?;
    let commands = session.command_publisher(name)?;
    let control = session.publisher::<RunControl>(&services::RUN_CONTROL)?;
    let requests = session.publisher::<DrrRequest>(&services::DRR_REQUEST)?;
    let events = session.publisher::<Event>(&services::EVENT)?;
    let progress = bare_port(&session, "progress", size_of::<Progress>());
    let mut random = Rng::with_seed(seed);
    println!("\n{READY}");
    loop {
        let mut bytes = |most: usize| -> Vec<u8> {
            // One in four has the correct length.
            let length = if random.u64(..4) == 0 { most } else { random.u64(..most as u64) as usize };
            (0..length).map(|_| random.u8(..)).collect()
        };
        commands.send_parts(&[&bytes(size_of::<Command>())])?;
        control.send_parts(&[&bytes(size_of::<RunControl>())])?;
        requests.send_parts(&[&bytes(size_of::<DrrRequest>())])?;
        events.send_parts(&[&bytes(size_of::<Event>())])?;
        send_bare(&progress, &bytes(size_of::<Progress>()));
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Joins as a program with other layouts, then as one with another transport; both must be rejected by name.
fn other_version(folder: &Path) -> Result<(), String> {
    let session = Session::join(folder).map_err(|error| error.to_string())?;
    let layout = session.subscriber::<Command>(&services::STATE).err();
    let Some(SessionError::Layout { .. }) = layout else { return Err(format!("another layout: {layout:?}")) };
    let copy = tempfile::tempdir().unwrap();
    std::fs::set_permissions(copy.path(), std::os::unix::fs::PermissionsExt::from_mode(0o700)).unwrap();
    let mut announcement = session.announcement().clone();
    announcement.iceoryx2 = "0.9.0".to_owned();
    std::fs::write(copy.path().join("session.json"), serde_json::to_string(&announcement).unwrap()).unwrap();
    let transport = Session::join(copy.path()).err();
    let Some(SessionError::Transport { .. }) = transport else {
        return Err(format!("another transport: {transport:?}"));
    };
    println!("\n{READY}");
    Ok(())
}
