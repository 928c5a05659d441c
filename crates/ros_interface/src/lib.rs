//! The ROS 2 interface of a session: its topics, their messages, and the requests of received messages.
//!
//! Topics and verbs are those of CRTK, the Collaborative Robotics Toolkit
//! (github.com/collaborative-robotics/documentation): `measured_js`, `setpoint_js`, `measured_cp`,
//! `measured_cv`, `measured_cf`, `servo_jp`, `servo_jv`, `servo_jf`, `move_jp`, `servo_cp`, `move_cp`,
//! `operating_state`, `state_command`. SI units; the frame `world` is the patient frame, LPS.
//!
//! **Boundary:** states, frames and bytes in, bytes and commands out; no sockets, no clock (times are passed
//! as numbers). DDS is handled by `bridge_proc`. **Invariants:** for any received bytes, the requests
//! accepted by [`incoming::read`] are finite, complete and within the ranges that the physics accepts; a
//! velocity that is not repeated times out.
//!
//! ```
//! use ros_interface::cdr::{self, Order};
//! use ros_interface::commander::Motion;
//! use ros_interface::incoming::{self, CommandedJoints, Request};
//! use ros_interface::msg::JointState;
//! use ros_interface::topics::Input;
//!
//! let pull = JointState { effort: vec![5.0], ..JointState::default() };
//! let bytes = cdr::encode(&pull).unwrap();
//! let asked = incoming::read(Input::TendonServoJf, &bytes, Order::Little, CommandedJoints { arm: &[], tendons: 1 }).unwrap();
//! assert_eq!(asked, Request::Move(Motion::TendonServoJf([5.0, 0.0, 0.0, 0.0])));
//! ```
//!
//! | module | contents |
//! |---|---|
//! | [`topics`] | names, types and quality of service of all topics |
//! | [`msg`], [`cdr`] | the messages and their bytes |
//! | [`definition`] | any message by its definition as text |
//! | [`outgoing`], [`image`], [`bone`], [`robot`], [`urdf`] | from states, frames and voxels to messages |
//! | [`incoming`], [`commander`], [`trajectory`] | from messages to commands |
//! | [`lockstep`], [`round_trip`] | which messages answer a state, and how late they are |

pub mod bone;
pub mod cdr;
pub mod commander;
pub mod definition;
pub mod image;
pub mod incoming;
pub mod lockstep;
pub mod msg;
pub mod outgoing;
pub mod robot;
pub mod round_trip;
pub mod topics;
pub mod trajectory;
pub mod urdf;
