//! A session as ROS 2 sees it: which topics there are, which messages they carry, and what a message that
//! comes in asks for.
//!
//! Topics and verbs are those of CRTK, the Collaborative Robotics Toolkit
//! (github.com/collaborative-robotics/documentation): `measured_js`, `setpoint_js`, `measured_cp`,
//! `measured_cv`, `measured_cf`, `servo_jp`, `servo_jv`, `servo_jf`, `move_jp`, `servo_cp`, `move_cp`,
//! `operating_state`, `state_command`. SI units; the frame `world` is the patient frame, LPS.
//!
//! **Boundary:** states, frames and bytes in, bytes and commands out; no sockets, no clock (times come in as
//! numbers). DDS is `bridge_proc`'s. **Invariants:** whatever bytes come in, what [`incoming::read`] accepts
//! is finite, complete and within the ranges that the physics accepts; a velocity that is not repeated runs
//! out.
//!
//! ```
//! use ros_interface::cdr::{self, Order};
//! use ros_interface::commander::Motion;
//! use ros_interface::incoming::{self, Commanded, Request};
//! use ros_interface::msg::JointState;
//! use ros_interface::topics::Input;
//!
//! let pull = JointState { effort: vec![5.0], ..JointState::default() };
//! let bytes = cdr::encode(&pull).unwrap();
//! let asked = incoming::read(Input::TendonServoJf, &bytes, Order::Little, Commanded { arm: &[], tendons: 1 }).unwrap();
//! assert_eq!(asked, Request::Move(Motion::TendonServoJf([5.0, 0.0, 0.0, 0.0])));
//! ```
//!
//! | module | what it holds |
//! |---|---|
//! | [`topics`] | names, types and quality of service of all topics |
//! | [`msg`], [`cdr`] | the messages and their bytes |
//! | [`outgoing`], [`image`], [`robot`], [`urdf`] | from states and frames to messages |
//! | [`incoming`], [`commander`] | from messages to commands |

pub mod cdr;
pub mod commander;
pub mod image;
pub mod incoming;
pub mod msg;
pub mod outgoing;
pub mod robot;
pub mod topics;
pub mod urdf;
