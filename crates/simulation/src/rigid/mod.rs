//! The rigid scene: free, fixed and driven bodies (a bone fragment, a clamp, a table) in Rapier, coupled to
//! the manipulator by impulses.
//!
//! # One tick
//!
//! 1. Each proxy sphere gets, from every nearby body, the plane at its closest surface point
//!    ([`RigidScene::find_contacts`]). The shapes are convex, so this plane is the exact first-order
//!    obstacle. A sphere centre inside the shape gets the plane through the nearest surface point, which
//!    pushes it out the shortest way.
//! 2. [`RigidScene::step`] steps manipulator and bodies together: the planes of a free body move with it
//!    during the tick, and the body receives the tool's contact impulses, with opposite sign, at the contact
//!    points before Rapier solves the bodies. A driven body's planes carry its known velocity.
//!
//! # The coupling and its error
//!
//! Staggering the two once per tick (the tool meets a body of infinite mass, then the body receives the
//! impulse) makes a body of mass m bounce off a tool of effective mass M with restitution M / m. For one gram
//! against the tool's axial 0.3 kg that is a gain of 300. Instead, the two are iterated within the tick until
//! the plane motion that the tool assumed agrees with the motion of the bodies (`coupling`, `descent`). Both
//! see the same impulses regardless of the iteration's residual, so momentum is conserved to rounding. The
//! remaining errors are:
//!
//! - The residual of the iteration: the tool's assumed motion of a body is wrong by residual times dt, an
//!   overlap or gap that the next tick sees; 10 nm at 1 ms when converged. [`CouplingReport`] reports how the
//!   iteration ended.
//! - A plane keeps its direction during the tick: for a body that turns by an angle a, the gap has an error
//!   of order a^2.
//! - A free body that approaches the tool faster than the tool's push-out speed (0.05 m/s beyond the gap)
//!   overlaps it and is pushed out in the following ticks.
//! - Tool friction on a free body treats the surface as stationary, because the iteration moves its planes
//!   along their normals only. It is bounded by the cone mu N, acts on the body in full, and is too large
//!   where the surface moves along with the tool. The burr, with friction 0, is unaffected.
//!
//! A scene without bodies has no [`RigidScene`]; one whose bodies are all fixed does not step Rapier. Rapier
//! allocates in its steps, and so does copying its world during the iteration.

mod body;
mod coupling;
mod descent;
mod error;
mod query;
mod scene;
mod world;

pub use body::{BodyDrive, BodyMotion, BodyParameters, BodyShape, FASTEST_DRIVEN};
pub use coupling::{CouplingReport, ToolDrive};
pub use error::{DriveError, RigidError};
pub use scene::{RigidScene, RigidSnapshot};
