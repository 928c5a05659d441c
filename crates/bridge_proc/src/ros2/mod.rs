//! The ROS 2 bridge over DDS: publishes states, images and transforms; receives CRTK commands. Needs no ROS
//! installation.

mod bone;
mod error;
mod listener;
mod loopback;
mod memory;
mod node;
mod notices;
mod payload;
mod session;

use std::time::{Duration, Instant};

use ipc_types::process::EndRequest;
use ros_interface::image::ImageForm;
use ros_interface::round_trip::RoundTrips;
use ros_interface::topics::Names;

pub use error::Ros2Error;
pub use listener::Listener;
pub use memory::{MOST_MEMORY_BYTES, bound_memory};

use node::Node;
use notices::Notices;
use session::Ros2Session;

/// Which programs can receive the bridge's messages and, if it is a controller, command it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum NetworkScope {
    /// Programs on this machine.
    #[default]
    Localhost,
    /// Programs on the networks of this machine.
    Subnet,
}

/// Options of the bridge.
#[derive(Debug, Clone)]
pub struct Ros2Options {
    /// The session's folder or name; `None`: discovered as by any client.
    pub session: Option<String>,
    /// The scene's controller that the bridge acts as; `None`: it only observes the run.
    pub controller: Option<String>,
    /// Names used in topics and frames.
    pub names: Names,
    /// The DDS domain, 0 to 232.
    pub domain_id: u16,
    /// Which programs can reach it.
    pub reach: NetworkScope,
    /// States per second, 0.1 to 1000.
    pub rate_hz: f64,
    /// How images are sent.
    pub image: ImageForm,
    /// Whether each state waits for the commands that carry its stamp.
    pub lockstep: bool,
}

/// Statistics of a bridge.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Summary {
    /// Messages published.
    pub published: u64,
    /// Messages skipped because a reliable subscriber has not acknowledged older ones.
    pub left_out: u64,
    /// Messages received.
    pub received: u64,
    /// Received messages that were rejected.
    pub refused: u64,
    /// Messages that publishers have sent and the bridge has not received.
    pub lost: u64,
    /// Times from a state to the command with its stamp: simulated time in real time, measured time in
    /// lockstep.
    pub round_trips: RoundTrips,
}

/// Reported when the bridge is ready.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Ready {
    /// Whether the operating system restricts access to programs of this machine; `None` if that was not
    /// requested.
    pub is_closed: Option<bool>,
    /// Number of topics it subscribes to.
    pub listens: usize,
}

/// Runs the bridge until the session ends or an end is requested. `ready` is called once its topics exist;
/// `note` receives lines about rejected messages, at most one per second.
///
/// # Errors
/// No session; the domain cannot be joined; the session was lost.
pub fn serve(
    options: &Ros2Options,
    end: &EndRequest,
    ready: impl FnOnce(Ready),
    note: impl FnMut(&str),
) -> Result<Summary, Ros2Error> {
    let mut notices = Notices::new(note);
    let mut joined = Ros2Session::connect(options)?;
    // The names in topics and frames are known with the first state.
    while !joined.has_begun() {
        if end.is_set() || !joined.advance()? {
            return Ok(Summary::default());
        }
    }
    let mut node = Node::open(options, &joined.inputs())?;
    joined.introduce(&mut node)?;
    ready(Ready { is_closed: node.is_closed(), listens: node.listens() });
    let period = Duration::from_secs_f64(1.0 / options.rate_hz);
    let mut due = Instant::now();
    while !end.is_set() && joined.advance_until(due)? {
        joined.obey(&mut node, &mut notices);
        let now = Instant::now();
        if options.lockstep || now >= due {
            // The mean rate is kept, but longer delays are not made up for: subscribers want the newest
            // state.
            due = (due + period).max(now);
            joined.publish(&mut node, &mut notices);
        }
    }
    joined.publish(&mut node, &mut notices);
    joined.publish_rest(&mut node, &mut notices);
    notices.close();
    Ok(Summary { round_trips: joined.round_trips(), ..node.close() })
}
