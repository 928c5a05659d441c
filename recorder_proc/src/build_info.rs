//! Identifies this build in its logs.

use run_log::BuildInfo;

/// This build, from `build.rs`.
pub fn current() -> BuildInfo {
    let rustc = env!("TRABECULA_RUSTC");
    BuildInfo {
        version: concat!(env!("CARGO_PKG_VERSION"), "+", env!("TRABECULA_SOURCE")).to_string(),
        target: env!("TRABECULA_TARGET").to_string(),
        rustc: (!rustc.is_empty()).then(|| rustc.to_string()),
    }
}
