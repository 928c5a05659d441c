//! Plain iceoryx2 between two processes: a message of a state's size out, one of a command's size back. No
//! layout check, no sequence numbers, no validation: the lower bound for a multi-process lockstep tick on
//! this machine.

use std::path::Path;
use std::process::{Child, Command as Program};
use std::time::{Duration, Instant};

use clap::ValueEnum;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::{AllocationStrategy, Node, PortFactory as _, ipc};
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use ipc_types::messages::layout::Message;
use ipc_types::messages::services;
use ipc_types::messages::{Command, ControllerIndex, State};
use ipc_types::process::{bind_to_parent, end_with_parent};
use ipc_types::scene;
use ipc_types::session::{Reader, SESSION_VARIABLE, Session, SessionHost, SessionPlan};
use ipc_types::wake::{Waiter, Waker};

use super::failed;
use super::samples::Samples;
use trabecula::failure::Failure;

/// How both sides wait.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Wait {
    /// Like the hub: yield for 20 µs, then sleep on the event.
    Hybrid,
    /// Always yield.
    Yield,
    /// Spin.
    Spin,
}

/// The answering side's name as a controller of its session.
const PONG: &str = "pong";
const PING_SERVICE: &str = "bench/ping";
const PONG_SERVICE: &str = "bench/pong";
/// Timeout for the other side.
const LIMIT: Duration = Duration::from_secs(10);

type Service = PortFactory<ipc::Service, [u8], ()>;

/// One side of the ping-pong.
struct Side {
    publisher: Publisher<ipc::Service, [u8], ()>,
    subscriber: Subscriber<ipc::Service, [u8], ()>,
    waiter: Waiter,
    waker: Waker,
    wait: Wait,
}

impl Side {
    fn new(
        session: &Session,
        wait: Wait,
        out: &Service,
        back: &Service,
        ends: [Reader; 2],
    ) -> Result<Side, Failure> {
        let bytes = State::DESCRIPTION.size.max(Command::DESCRIPTION.size);
        let publisher = out
            .publisher_builder()
            .initial_max_slice_len(bytes)
            .allocation_strategy(AllocationStrategy::Static);
        Ok(Side {
            publisher: publisher.create().map_err(failed)?,
            subscriber: back.subscriber_builder().create().map_err(failed)?,
            waiter: session.waiter(ends[0]).map_err(failed)?,
            waker: session.waker(ends[1]).map_err(failed)?,
            wait,
        })
    }

    fn send(&self, bytes: &[u8]) -> Result<(), Failure> {
        let sample = self.publisher.loan_slice_uninit(bytes.len()).map_err(failed)?;
        sample.write_from_slice(bytes).send().map_err(failed)?;
        if self.wait == Wait::Hybrid {
            self.waker.wake();
        }
        Ok(())
    }

    /// Waits for a message and returns its first byte.
    fn receive(&self) -> Result<u8, Failure> {
        let limit = Instant::now() + LIMIT;
        loop {
            if let Some(sample) = self.subscriber.receive().map_err(failed)? {
                return Ok(sample.payload().first().copied().unwrap_or(0));
            }
            match self.wait {
                Wait::Hybrid => {
                    self.waiter.wait_until(limit, || self.subscriber.has_samples().unwrap_or(true));
                }
                Wait::Yield => std::thread::yield_now(),
                Wait::Spin => std::hint::spin_loop(),
            }
            if Instant::now() >= limit {
                return Err(Failure::failed("ping-pong: the other side does not answer"));
            }
        }
    }
}

fn create(node: &Node<ipc::Service>, name: &str) -> Result<Service, Failure> {
    let name = name.try_into().map_err(failed)?;
    // The same limits as the hub's state service.
    node.service_builder(&name)
        .publish_subscribe::<[u8]>()
        .enable_safe_overflow(true)
        .subscriber_max_buffer_size(services::STATE.queue_length)
        .subscriber_max_borrowed_samples(2)
        .history_size(0)
        .max_publishers(1)
        .max_subscribers(services::STATE.max_subscribers)
        .create()
        .map_err(failed)
}

fn open(node: &Node<ipc::Service>, name: &str) -> Result<Service, Failure> {
    let name = name.try_into().map_err(failed)?;
    node.service_builder(&name).publish_subscribe::<[u8]>().open().map_err(failed)
}

/// Measures round trips of a ping-pong with a separate process.
///
/// # Errors
/// Any error of the transport, or the other side does not answer.
pub fn measure(wait: Wait, rounds: usize) -> Result<Samples, Failure> {
    measure_on(wait, rounds, |start| start())
}

/// Like [`measure`]; `place` starts the other side on its core.
///
/// # Errors
/// Same as [`measure`].
pub fn measure_on(
    wait: Wait,
    rounds: usize,
    place: impl FnOnce(&mut dyn FnMut() -> Result<Child, Failure>) -> Result<Child, Failure>,
) -> Result<Samples, Failure> {
    let plan = SessionPlan {
        controllers: vec![PONG.to_owned()],
        volume_bytes: 0,
        frame_bytes: 0,
        sensors: false,
        tip_jacobian: false,
        recorder: false,
        wait: scene::Wait::Hybrid,
        policy: scene::Policy::Other,
    };
    let host = SessionHost::create(&plan).map_err(failed)?;
    let session = &host.session;
    let (out, back) = (create(session.node(), PING_SERVICE)?, create(session.node(), PONG_SERVICE)?);
    let side =
        Side::new(session, wait, &out, &back, [Reader::Physics, Reader::Controller(ControllerIndex(0))])?;
    host.announce().map_err(failed)?;
    let mut child = place(&mut || start_pong(session.folder(), wait, rounds))?;
    let samples = connected(&out, &back).and_then(|()| play(&side, rounds));
    if samples.is_err() {
        // It may already have ended.
        let _ = child.kill();
    }
    child.wait().map_err(failed)?;
    samples
}

fn start_pong(session: &Path, wait: Wait, rounds: usize) -> Result<Child, Failure> {
    let program = std::env::current_exe().map_err(failed)?;
    let wait = wait.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned());
    let mut command = Program::new(program);
    command
        .args(["bench", "pong", "--wait", &wait, "--rounds", &rounds.to_string()])
        .env(SESSION_VARIABLE, session);
    bind_to_parent(&mut command).spawn().map_err(failed)
}

fn connected(out: &Service, back: &Service) -> Result<(), Failure> {
    let limit = Instant::now() + LIMIT;
    while out.dynamic_config().number_of_subscribers() == 0
        || back.dynamic_config().number_of_publishers() == 0
    {
        if Instant::now() >= limit {
            return Err(Failure::failed("ping-pong: the other side does not connect"));
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    Ok(())
}

fn play(side: &Side, rounds: usize) -> Result<Samples, Failure> {
    let mut samples = Samples::default();
    let message = vec![1_u8; State::DESCRIPTION.size];
    for _ in 0..rounds {
        let began = Instant::now();
        side.send(&message)?;
        side.receive()?;
        samples.add(began.elapsed().as_nanos() as u64);
    }
    Ok(samples)
}

/// Runs the answering side in its own process.
///
/// # Errors
/// Any error of the transport, or no message arrives.
pub fn answer(session: &Path, wait: Wait, rounds: usize) -> Result<(), Failure> {
    end_with_parent();
    let session = Session::join(session).map_err(failed)?;
    let (out, back) = (open(session.node(), PONG_SERVICE)?, open(session.node(), PING_SERVICE)?);
    let side =
        Side::new(&session, wait, &out, &back, [Reader::Controller(ControllerIndex(0)), Reader::Physics])?;
    let mut message = vec![0_u8; Command::DESCRIPTION.size];
    for _ in 0..rounds {
        message[0] = side.receive()?;
        side.send(&message)?;
    }
    Ok(())
}
