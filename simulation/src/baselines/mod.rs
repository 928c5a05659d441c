//! Methods that others use, on the same tool: for charts and the stability map only.
//!
//! | method | what it is |
//! |---|---|
//! | [`explicit_chain`] | the chain with springs and dampers as forces: semi-implicit Euler |
//! | [`RapierChain`] of [`RapierJoints::Multibody`] | Rapier's multibody of hinges with implicit joint springs |
//! | [`RapierChain`] of [`RapierJoints::Springs`] | rigid bodies held by six-axis spring joints, solved by impulses |
//! | [`ProxyTool`] | a proxy of the burr that stays outside, to which the burr is set ([`ProxyDrive::Position`]) or pulled |

mod proxy;
pub mod published;
mod rapier_chain;
mod wall;

use crate::manipulator::{BaseMotion, ManipulatorError, ManipulatorParameters, SpatialChain};

pub use proxy::{ProxyDrive, ProxyTool, proxy_of};
pub use rapier_chain::{RapierChain, RapierJoints};
pub use wall::Wall;

/// The planar chain with explicit springs: stable only while dt is below 2 / omega of its highest mode.
///
/// # Errors
/// A parameter that is refused, by name.
pub fn explicit_chain(
    parameters: ManipulatorParameters,
    base: &BaseMotion,
) -> Result<SpatialChain<1>, ManipulatorError> {
    Ok(SpatialChain::new(parameters, base)?.with_explicit_springs())
}
