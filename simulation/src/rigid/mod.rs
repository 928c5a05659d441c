//! The rigid scene: free or fixed bodies (a bone fragment, a clamp) in Rapier, coupled to the manipulator by impulses.
//!
//! # One tick
//!
//! 1. Every proxy sphere asks every near body for the plane of its closest surface point ([`RigidScene::find_contacts`]).
//!    The shapes are convex, so that this plane is the exact first-order obstacle; a sphere centre inside the shape gets
//!    the plane through the nearest surface point, which pushes it out the shortest way.
//! 2. [`RigidScene::step`] steps manipulator and bodies together: the planes of a free body move with it through the
//!    tick, and what the tool's contacts exert is given to the body, with the opposite sign, at the contact points, before
//!    Rapier solves the bodies among themselves.
//!
//! # The coupling and its error
//!
//! Staggering the two once a tick (the tool meets a body of infinite mass, then the body gets the impulse) makes a body
//! of mass m bounce off a tool of effective mass M with the restitution M / m: for one gram before the tool's axial
//! 0.3 kg that is a gain of 300 ([`Coupling::Staggered`], kept as a baseline). So the two are iterated within the tick until the motion of the planes that the tool was
//! told is the one that the bodies make (`coupling`, `descent`); both see the same impulses, whatever the iteration's residual, so
//! that momentum is balanced to rounding. What remains:
//!
//! - the residual of the iteration: the tool's idea of a body's motion is wrong by residual times dt, an overlap or gap
//!   that the next tick sees; 10 nm at 1 ms when converged ([`CouplingReport`] says how it ended);
//! - the plane keeps its direction through the tick: a body turning by a does so with an error of order a^2 in the gap;
//! - a body that comes at the tool faster than the tool's push-out speed (0.05 m/s beyond the gap) overlaps it and is
//!   pushed out in the next ticks;
//! - the tool's friction on a free body is that against a surface at rest, because a contact plane carries no tangential
//!   velocity: it is bounded by the cone mu N, given to the body in full, and too large where the surface moves along.
//!   The burr, with friction 0, is not concerned.
//!
//! A scene without bodies has no [`RigidScene`]; one without free bodies does not step Rapier. Rapier allocates in its
//! steps, and so does the copying of its world in the iteration.

mod body;
mod coupling;
mod descent;
mod error;
mod query;
mod scene;
mod world;

pub use body::{BodyMotion, BodyParameters, BodyShape};
pub use coupling::{Coupling, CouplingReport, ToolDrive};
pub use error::RigidError;
pub use scene::{RigidScene, RigidSnapshot};
