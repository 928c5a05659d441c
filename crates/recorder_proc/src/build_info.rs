//! Identifies this build in its logs.

use run_log::BuildInfo;

/// The build's name in logs and in `trabecula --version`: the version and a hash of the sources that decide a
/// tick.
pub const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), "+", env!("TRABECULA_SOURCE"));

/// Returns this build, as recorded by `build.rs`.
pub fn current() -> BuildInfo {
    let rustc = env!("TRABECULA_RUSTC");
    BuildInfo {
        version: VERSION.to_string(),
        target: env!("TRABECULA_TARGET").to_string(),
        rustc: (!rustc.is_empty()).then(|| rustc.to_string()),
    }
}
