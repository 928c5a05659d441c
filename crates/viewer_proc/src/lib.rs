//! The viewer: a page in the browser and the Foxglove WebSocket protocol, for a running session or for logs.
//!
//! Runs only on request. It reads a session as any client does and never holds it up: it takes what has
//! arrived and drops what its own clients do not read in time.
//!
//! **Boundary:** the only async runtime; no third-party code in the page, no requests to any other server.
//! **Invariants:** each client's queue is bounded; without the token a client cannot control or change
//! anything, and takes neither a slot nor a place in a queue from clients that have it.
//!
//! ```
//! use viewer_proc::surface::{Field, Voxel};
//! use voxel_grid::VoxelGrid;
//!
//! // Ten voxels a side, 1 mm apart; bone from 200 HU on.
//! let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
//! let grid = VoxelGrid::new([10; 3], [1e-3; 3], [0.0; 3], axes)?;
//! let mut field = Field::new(grid, 200);
//! assert!(field.set(0, Voxel::Removed));
//! assert_eq!(field.removed(), [0]);
//! # Ok::<(), voxel_grid::GridError>(())
//! ```
//!
//! | module | contents |
//! |---|---|
//! | [`live`] | a running session: messages, run control, driving |
//! | [`log`] | logs on a time line |
//! | [`plan`] | a scene before its run: shown, changed, saved, started |
//! | [`surface`], [`removals`] | the bone's surface, block by block, links of the arm; removed voxels |
//! | [`mod@slice`] | planes through the CT, on request |
//! | [`server`], [`protocol`], [`services`], [`calls`] | HTTP, WebSocket, client requests and their queue |
//! | [`board`], [`channels`] | what clients subscribe to; [`delivery::viewer`] decides what each gets |
//! | [`scene_update`] | the tool for other viewers |
//! | [`info`](mod@info), [`assets`] | the scene as the page needs it, the page's files |

pub mod assets;
pub mod board;
pub mod calls;
pub mod channels;
pub mod error;
pub mod info;
mod left;
pub mod live;
pub mod log;
pub mod plan;
pub mod protocol;
pub mod removals;
pub mod scene_update;
pub mod server;
pub mod services;
pub mod slice;
mod structure_meshes;
pub mod surface;
mod threads;

pub use error::ViewerError;
pub use info::{ArmMeshes, ToolShape};
pub use server::ServerOptions;
