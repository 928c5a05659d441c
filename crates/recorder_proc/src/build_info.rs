//! Identifies this build in its logs.

use run_log::BuildInfo;

/// Version and a hash of the sources that decide a tick: what names a build, in logs and in
/// `trabecula --version`.
pub const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), "+", env!("TRABECULA_SOURCE"));

/// This build, from `build.rs`.
pub fn current() -> BuildInfo {
    let rustc = env!("TRABECULA_RUSTC");
    BuildInfo {
        version: VERSION.to_string(),
        target: env!("TRABECULA_TARGET").to_string(),
        rustc: (!rustc.is_empty()).then(|| rustc.to_string()),
    }
}
