//! Bridges from a running session to other software: of the operating room, and of robotics.
//!
//! A bridge joins a session as any client does, as an observer or, where it is given a controller's name, as
//! that controller: then what it commands is latched, recorded and replayed like every other command. It
//! never holds up the session: what a peer does not read in time is replaced by what is newer, and counted.
//!
//! **Boundary:** sockets, threads and the client library; the bytes of OpenIGTLink are [`openigtlink`]'s,
//! topics and messages of ROS 2 [`ros_interface`]'s. **Invariants:** a peer's queue holds one message a name;
//! a peer without permission changes nothing; what it sends that is too large, damaged or unknown is refused
//! with a reason and the run goes on.
//!
//! ```
//! use bridge_proc::ras;
//!
//! // Slicer's RAS in millimetres differs from our LPS in metres in the signs of x and y.
//! assert_eq!(ras::position_mm([0.010, -0.020, 0.030]), [-10.0, 20.0, 30.0]);
//! ```
//!
//! | module | what it holds |
//! |---|---|
//! | [`igtl`] | OpenIGTLink: 3D Slicer, PLUS, trackers |
//! | [`ros2`] | ROS 2 over DDS, with CRTK's topics |
//! | [`ras`] | Slicer's frame, RAS in millimetres, and ours |

pub mod igtl;
pub mod ras;
pub mod ros2;
