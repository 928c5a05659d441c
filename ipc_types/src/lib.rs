//! The transport: sessions, ports, waiting and waking over iceoryx2, and what all of the hub's processes
//! share.
//!
//! **Boundary:** moves messages without knowing their meaning; nothing below it (`messages`, `scene`) knows
//! iceoryx2. It re-exports both, so that a client depends on one crate.
//!
//! **Invariants:** only the host creates services; no reader blocks a writer, and a reader that loses a
//! message can tell; each `unsafe` states its proof. New memory is reserved and touched first, so that a full
//! `/dev/shm` is an error and not a signal.
//!
//! A client joins a session, opens ports of its services and takes the messages that have arrived:
//!
//! ```no_run
//! use std::path::Path;
//!
//! use ipc_types::messages::State;
//! use ipc_types::messages::services;
//! use ipc_types::session::Session;
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
//! | [`messages`] | the crate `messages` |
//! | [`session`], [`ports`], [`wake`] | creating and joining a session, sending and receiving, waiting and waking |
//! | [`own`] | resources that a `fork` child inherits but must not clean up |
//! | [`identity`] | which controller or part sent a message, according to the transport |
//! | [`scene`], [`scene_file`] | the crate `scene`; scenes from files |
//! | [`arm_meshes`] | the meshes of an arm, from files |
//! | [`text_file`] | reading text files that a user names |
//! | [`process`] | exit codes, priorities, events, requests to end, parents and children: what all processes share |
//! | [`clock`] | the monotonic clock |
//! | [`reference`](mod@reference) | docs/messages.md, generated |

pub mod arm_meshes;
mod client;
pub mod clock;
mod family;
mod half_made;
pub mod identity;
pub mod own;
pub mod ports;
pub mod process;
pub mod reference;
pub mod scene_file;
pub mod session;
mod shared_memory;
mod shared_page;
mod signals;
pub mod text_file;
mod transport_reference;
pub mod wake;

pub use ::{messages, scene};
