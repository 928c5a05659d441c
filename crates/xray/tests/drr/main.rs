//! Tests of the X-ray model against closed forms, tables and itself.
//!
//! The modules are `cfg(test)` so that clippy treats their helpers as test code, which may unwrap.

#[cfg(test)]
mod attenuation;
#[cfg(test)]
mod bad_input;
#[cfg(test)]
mod batches;
#[cfg(test)]
mod camera;
#[cfg(test)]
mod coefficients;
#[cfg(test)]
mod cutters;
#[cfg(test)]
mod detector;
#[cfg(test)]
mod frames;
#[cfg(test)]
mod geometry;
#[cfg(test)]
mod itk;
#[cfg(test)]
mod labels;
#[cfg(test)]
mod ladder;
#[cfg(test)]
mod machine;
mod mitres;
#[cfg(test)]
mod objects;
#[cfg(test)]
mod poses;
#[cfg(test)]
mod projectors;
#[cfg(test)]
mod scatter;
#[cfg(test)]
mod slice_ordered;
#[cfg(test)]
mod slice_ordered_changes;
#[cfg(test)]
mod slice_ordered_poses;
#[cfg(test)]
mod solids;
#[cfg(test)]
mod spectrum;
#[cfg(test)]
mod tool;

/// Runs a script in an environment with pinned packages. If the environment cannot be created, prints a
/// message and returns `None`; in CI this is a failure.
#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "helpers of tests")]
fn run_python(name: &str, packages: &[&str], probe: &str, script: &str) -> Option<String> {
    let python = test_support::python::or_skip(name, packages, probe)?;
    let output = test_support::limited::Limited::limited_output(
        std::process::Command::new(&python).args(["-c", script]),
    )
    .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Some(String::from_utf8(output.stdout).unwrap())
}
