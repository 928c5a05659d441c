//! ROS 2 over DDS: states, images and transforms out; CRTK commands in. No ROS installation is needed.

mod error;
mod listener;
mod loopback;
mod node;
mod notices;
mod payload;
mod session;

use std::time::{Duration, Instant};

use ipc_types::process::EndRequest;
use ros_interface::image::ImageForm;
use ros_interface::topics::Names;

pub use error::Ros2Error;
pub use listener::Listener;

use node::Node;
use notices::Notices;
use session::Joined;

/// Who can hear the bridge and, where it is a controller, command it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Reach {
    /// Programs on this machine.
    #[default]
    Localhost,
    /// Programs in the networks that this machine is in.
    Subnet,
}

/// What the bridge is to do.
#[derive(Debug, Clone)]
pub struct Ros2Options {
    /// The session's folder or name; `None`: as a client finds it.
    pub session: Option<String>,
    /// The scene's controller that the bridge is; `None`: it only shows the run.
    pub controller: Option<String>,
    /// Names in topics and frames.
    pub names: Names,
    /// The DDS domain, 0 to 232.
    pub domain_id: u16,
    /// Who can reach it.
    pub reach: Reach,
    /// States a second, 0.1 to 1000.
    pub rate_hz: f64,
    /// How images are sent.
    pub image: ImageForm,
}

/// What a bridge did.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Summary {
    /// Messages that were published.
    pub published: u64,
    /// Messages that were left out, because a reliable subscriber has not acknowledged older ones.
    pub left_out: u64,
    /// Messages that came in.
    pub received: u64,
    /// How many of them were refused.
    pub refused: u64,
}

/// What the bridge says when it is ready.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Ready {
    /// Whether the operating system keeps everybody but this machine's programs out; `None` where that was
    /// not asked for.
    pub is_closed: Option<bool>,
    /// Topics that it listens to.
    pub listens: usize,
}

/// Runs the bridge until the session ends or an end is requested. `ready` hears when its topics are there;
/// `note` gets lines on what was refused, at most one a second.
///
/// # Errors
/// No session, no place on the domain; the session's loss.
pub fn serve(
    options: &Ros2Options,
    end: &EndRequest,
    ready: impl FnOnce(Ready),
    note: impl FnMut(&str),
) -> Result<Summary, Ros2Error> {
    let mut notices = Notices::new(note);
    let mut joined = Joined::connect(options)?;
    // What stands in topics and frames is known with the first state.
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
        if now >= due {
            // The mean rate is kept, but what was missed for longer is not made up for: subscribers want what
            // is newest.
            due = (due + period).max(now);
            joined.publish(&mut node);
        }
    }
    joined.publish(&mut node);
    notices.close();
    Ok(node.close())
}
