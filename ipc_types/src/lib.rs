//! Messages, service names, ports, tick protocol and scene files: what every process of the hub shares.
//!
//! A client joins a session, opens ports of its services and takes what has arrived:
//!
//! ```no_run
//! use std::path::Path;
//!
//! use ipc_types::messages::State;
//! use ipc_types::{services, session::Session};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let folder = std::env::var(ipc_types::session::SESSION_VARIABLE)?;
//! let session = Session::join(Path::new(&folder))?;
//! let states = session.subscriber::<State>(&services::STATE)?;
//! while let Some(state) = states.receive()? {
//!     println!("{} {:?}", state.message().tick, state.message().t_world_tip.position_m);
//! }
//! # Ok(())
//! # }
//! ```
//!
//! | module | what it holds |
//! |---|---|
//! | [`messages`], [`layout`] | the messages; one declaration gives struct, schema, field table and layout hash |
//! | [`services`] | names, queues, lanes |
//! | [`session`], [`ports`], [`wake`] | creating and joining a session, sending and receiving, waiting and waking |
//! | [`own`] | what a child of `fork` inherits and does not clean up |
//! | [`identity`] | which controller a message comes from, as the transport knows it |
//! | [`ration`] | what a reader grants programs that flood |
//! | [`command_check`] | what a command must be before it may reach the model |
//! | [`scene`] | scene files |
//! | [`text_file`] | reading text files that a user names |
//! | [`process`] | exit codes, priorities, events: what every process does alike |
//! | [`signals`], [`family`], [`patience`] | being asked to end; parents and children; limits that a suspended process does not lose |
//! | [`reference`](mod@reference), [`scene_reference`] | docs/messages.md and docs/scene.md, generated |

mod client;
pub mod command_check;
pub mod family;
pub mod identity;
pub mod layout;
pub mod messages;
pub mod own;
pub mod patience;
pub mod ports;
pub mod process;
pub mod ration;
pub mod reference;
pub mod scene;
pub mod scene_reference;
pub mod services;
pub mod session;
mod shared_memory;
pub mod signals;
pub mod text_file;
mod transport_reference;
pub mod wake;
