//! Published methods applied to the same tool: for charts and the stability map only.
//!
//! | method | description |
//! |---|---|
//! | [`explicit_chain`] | the chain with springs and dampers as explicit forces: semi-implicit Euler |
//! | [`RapierChain`] of [`RapierJoints::Multibody`] | Rapier's multibody of hinges with implicit springs |
//! | [`RapierChain`] of [`RapierJoints::Springs`] | rigid bodies with six-axis spring joints, by impulses |
//! | [`ProxyTool`] | a proxy of the burr stays outside the walls; the burr is set to it or pulled |

mod proxy;
pub mod published;
mod rapier_chain;
mod wall;

use simulation::manipulator::{BaseMotion, ManipulatorError, ManipulatorParameters, SpatialChain};

pub use proxy::{ProxyDrive, ProxyTool, proxy_of};
pub use rapier_chain::{RapierChain, RapierJoints};
pub use wall::Wall;

/// The planar chain with explicit springs: stable only for dt below 2 / omega of its highest mode.
///
/// # Errors
/// A parameter is out of range; the error names it.
pub fn explicit_chain(
    parameters: ManipulatorParameters,
    base: &BaseMotion,
) -> Result<SpatialChain<1>, ManipulatorError> {
    Ok(SpatialChain::new(parameters, base)?.with_explicit_springs())
}
