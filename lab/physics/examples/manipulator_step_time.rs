//! Prints the time of one manipulator step, and of the tip Jacobian after it, in free motion and with
//! contacts.
//!
//! `cargo run --release -p physics_lab --example manipulator_step_time [-- CASE [STEPS]]` runs all cases, or
//! those whose name contains CASE.
//!
//! `... manipulator_step_time -- --instructions [CASE]` also counts the instructions of both, which other
//! load does not affect: every case runs again under `valgrind --tool=callgrind
//! --toggle-collect='*one_step*'`, then with `'*one_jacobian*'`.
//!
//! The 27-flexure tool, with a tendon tension that alternates between 6 and 8 N every 200 ms, swings freely,
//! is pressed onto a winding wall, or is in a winding tunnel.

use std::hint::black_box;
use std::process::Command;
use std::time::Instant;

use nalgebra::{Isometry3, Unit, Vector3};
use simulation::contact_plane::ContactPlane;
use simulation::manipulator::{
    AnyManipulator, BaseMotion, Integrator, ManipulatorError, ManipulatorModel, ManipulatorParameters, Rung,
    StepInput, StepReport, TendonCommand, TipJacobian, Wrench,
};

const STEPS: usize = 4000;

/// The timed code, which a profiler counts.
#[inline(never)]
fn one_step(m: &mut AnyManipulator, input: &StepInput) -> Result<StepReport, ManipulatorError> {
    m.step(1e-3, input)
}

/// The other timed code.
#[inline(never)]
fn one_jacobian(m: &AnyManipulator) -> TipJacobian {
    m.tip_jacobian()
}

/// A tunnel with `clearance_m` on both sides that winds with an amplitude of 0.3 mm and a wavelength of 12
/// mm: each of the `spheres` nearest the tip gets the walls on `sides`.
fn tunnel(m: &AnyManipulator, spheres: usize, sides: &[f64], clearance_m: f64, out: &mut Vec<ContactPlane>) {
    let wave = 2.0 * std::f64::consts::PI / 12.0e-3;
    for (sphere_index, sphere) in m.proxy_spheres().iter().enumerate().rev().take(spheres) {
        let phase = wave * (sphere.centre_m.z - 36.0e-3);
        let (centre, slope) = (0.3e-3 * libm::sin(phase), 0.3e-3 * wave * libm::cos(phase));
        let across = Unit::new_normalize(Vector3::new(1.0, 0.0, -slope));
        for &side in sides {
            let gap_m = side * (sphere.centre_m.x - centre) * across.x + clearance_m;
            let normal = Unit::new_unchecked(across.into_inner() * side);
            let point_m = sphere.centre_m - normal.into_inner() * (gap_m + sphere.radius_m);
            out.push(ContactPlane::hard(sphere_index, point_m, normal, gap_m));
        }
    }
}

/// Options of the command line.
struct Options {
    case: String,
    steps: usize,
    instructions: bool,
}

impl Options {
    fn read() -> Options {
        let mut arguments: Vec<String> = std::env::args().skip(1).collect();
        let instructions = arguments.first().is_some_and(|argument| argument == "--instructions");
        arguments.drain(..usize::from(instructions));
        let steps = arguments.get(1).and_then(|steps| steps.parse().ok()).unwrap_or(STEPS).max(100);
        Options { case: arguments.first().cloned().unwrap_or_default(), steps, instructions }
    }
}

/// Returns the mean number of instructions of `counted`, from this program under callgrind with one case.
fn instructions(name: &str, counted: &str) -> Result<u64, Box<dyn std::error::Error>> {
    const COUNTED_STEPS: u64 = 1000;
    let output = Command::new("valgrind")
        .args([
            "--tool=callgrind",
            "--callgrind-out-file=/dev/null",
            &format!("--toggle-collect=*{counted}*"),
        ])
        .arg(std::env::current_exe()?)
        .args([name, &COUNTED_STEPS.to_string()])
        .output()
        .map_err(|cause| format!("valgrind: {cause}; --instructions needs it (Debian package `valgrind`)"))?;
    let report = String::from_utf8_lossy(&output.stderr);
    let (_, counted) = report.split_once("Collected :").ok_or_else(|| format!("valgrind: {report}"))?;
    let digits = counted.split_whitespace().next().unwrap_or_default();
    Ok(digits.parse::<u64>().map_err(|cause| format!("valgrind counted `{digits}`: {cause}"))?
        / COUNTED_STEPS)
}

fn run(
    options: &Options,
    name: &str,
    (rung, integrator): (Rung, Integrator),
    planes: impl Fn(&AnyManipulator, &mut Vec<ContactPlane>),
) -> Result<(), Box<dyn std::error::Error>> {
    if !name.contains(&options.case) {
        return Ok(());
    }
    let steps = options.steps;
    let base = BaseMotion::at_rest(Isometry3::identity());
    let parameters = ManipulatorParameters { integrator, ..ManipulatorParameters::jhu_27() };
    let mut manipulator = AnyManipulator::new(rung, parameters, &base)?;
    let mut contacts = Vec::with_capacity(96);
    let [mut micros, mut jacobian_micros] = [0; 2].map(|_| Vec::with_capacity(steps));
    let (mut iterations, mut active, mut second_order, mut residual) = (0, 0, 0, 0.0f64);
    for k in 0..steps {
        contacts.clear();
        planes(&manipulator, &mut contacts);
        let tension = 8.0 - if (k / 200).is_multiple_of(2) { 2.0 } else { 0.0 };
        let input = StepInput {
            base,
            tendon: TendonCommand::Force([tension, 0.0]),
            tip_wrench: Wrench::zero(),
            contacts: &contacts,
        };
        let start = Instant::now();
        let report = black_box(one_step(&mut manipulator, black_box(&input))?);
        micros.push(start.elapsed().as_secs_f64() * 1e6);
        let start = Instant::now();
        black_box(one_jacobian(black_box(&manipulator)));
        jacobian_micros.push(start.elapsed().as_secs_f64() * 1e6);
        iterations += report.contact_iterations;
        active += report.active_contact_count;
        residual = residual.max(if k % 200 >= 100 { report.contact_residual_m_per_s } else { 0.0 });
        second_order += usize::from(report.integrator == Integrator::Hybrid);
    }
    for micros in [&mut micros, &mut jacobian_micros] {
        micros.sort_by(f64::total_cmp);
    }
    let counted = |what| match options.instructions {
        true => instructions(name, what).map(|count| format!(", {count} instructions")),
        false => Ok(String::new()),
    };
    println!(
        "{name:<34} {:>2} contacts ({:>4.1} active): median {:6.2} us, p99 {:6.2} us, {:4.1} iterations, \
         late residual {:7.1e} m/s, {:5.1} % ROS2{}; tip Jacobian: median {:5.2} us{}",
        contacts.len(),
        active as f64 / steps as f64,
        micros[steps / 2],
        micros[steps * 99 / 100],
        iterations as f64 / steps as f64,
        residual,
        100.0 * second_order as f64 / steps as f64,
        counted("one_step")?,
        jacobian_micros[steps / 2],
        counted("one_jacobian")?,
    );
    Ok(())
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let options = Options::read();
    for rung in Rung::ALL {
        let euler = (rung, Integrator::LinearlyImplicitEuler);
        let name = rung.name();
        run(&options, &format!("{name}, free, Euler"), euler, |_, _| ())?;
        if rung != Rung::ConstantCurvature {
            run(&options, &format!("{name}, free, hybrid"), (rung, Integrator::Hybrid), |_, _| ())?;
        }
        for spheres in [10, 28] {
            run(&options, &format!("{name}, winding wall of {spheres}"), euler, |m, out| {
                tunnel(m, spheres, &[-1.0], 0.0, out)
            })?;
        }
        for spheres in [5, 15, 28] {
            run(&options, &format!("{name}, winding tunnel of {spheres}"), euler, |m, out| {
                tunnel(m, spheres, &[1.0, -1.0], 20e-6, out);
            })?;
        }
    }
    Ok(())
}
