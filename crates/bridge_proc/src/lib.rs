//! Bridges from a running session to other software, in the operating room and in robotics, and to input
//! devices.
//!
//! A bridge joins a session like any client, as an observer or, if it is given a controller's name, as that
//! controller; its commands are then latched, recorded and replayed like any others. It never blocks the
//! session: messages that a peer does not read in time are replaced by newer ones, and counted.
//!
//! **Boundary:** sockets, threads and the client library; the bytes of OpenIGTLink are [`openigtlink`]'s job,
//! topics and messages of ROS 2 that of [`ros_interface`]. **Invariants:** a peer's queue holds one message
//! per name; a peer without permission changes nothing; oversized, damaged and unknown messages are rejected
//! with a reason and the run continues.
//!
//! ```
//! use bridge_proc::ras;
//!
//! // Slicer's RAS in millimetres differs from our LPS in metres in the signs of x and y.
//! assert_eq!(ras::position_mm([0.010, -0.020, 0.030]), [-10.0, 20.0, 30.0]);
//! ```
//!
//! | module | contents |
//! |---|---|
//! | [`igtl`] | OpenIGTLink: 3D Slicer, PLUS, trackers |
//! | [`ros2`] | ROS 2 over DDS, with CRTK's topics |
//! | [`device`] | gamepads, six-axis mice and pedals as controllers |
//! | [`ras`] | conversion between Slicer's frame (RAS, millimetres) and ours |

pub mod device;
pub mod igtl;
pub mod ras;
pub mod ros2;

use ipc_types::messages::{SensorKind, SensorReading};
use ipc_types::scene::Controller;
use trabecula_client::{Client, ClientError};

/// Returns the scene's entry of the controller that a client is, or `None` for an observer.
fn own_controller(client: &Client) -> Option<&Controller> {
    let (name, _) = client.info().controller.as_ref()?;
    client.scene().controller.iter().find(|controller| controller.name == *name)
}

/// Returns the newest unread reading of the clearances from critical structures.
fn newest_clearances(client: &mut Client) -> Option<SensorReading> {
    let mut newest = None;
    while let Ok(Some(reading)) = client.next_reading() {
        if reading.kind() == Ok(SensorKind::Clearance) {
            newest = Some(*reading);
        }
    }
    newest
}

/// Returns whether the user's input is at fault: no session, or an unknown or connected controller.
fn is_bad_input(error: &ClientError) -> bool {
    matches!(error, ClientError::NoSession { .. } | ClientError::Joining { .. } | ClientError::Session(_))
}
