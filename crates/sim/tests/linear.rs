//! State vectors and linear models of ticks: against differences by hand, against MuJoCo, and under feedback.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests fail")]

use std::io::Write as _;
use std::path::Path;
use std::process::{Command as Program, Stdio};
use std::sync::Arc;

use messages::{ArmMode, BodyMode, BurrMode, Command, TendonMode};
use nalgebra::{Complex, DMatrix, DVector};
use sim::{Batch, Drive, LinearModel, SharedScene, Sim, SimError};
use simulation::manipulator::{AnyManipulator, BaseMotion, ManipulatorModel, Rung};
use simulation::manipulator_parameters;
use test_support::limited::{COMMAND_LIMIT, limited_output_of};
use test_support::python;
use test_support::scenes::TOOL;

const RUN: &str = "name = \"a\"\nrun = { mode = \"lockstep\", duration_s = 10.0 }\n";

fn scene(keys: &str) -> Arc<SharedScene> {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("scene.toml");
    // Keys of the root come before all tables.
    let (first, last) = if keys.starts_with('[') { ("", keys) } else { (keys, "") };
    std::fs::write(&file, format!("{RUN}{first}\n{TOOL}{last}")).unwrap();
    SharedScene::load(Some(&file), &[], None).unwrap()
}

fn sim(keys: &str) -> Sim {
    Sim::new(&scene(keys), &Drive::Nothing).unwrap()
}

/// Pulls both tendons.
fn pull(tension_n: [f64; 2]) -> Command {
    let mut command = Command {
        tendon_mode: TendonMode::ServoJf.code(),
        arm_mode: ArmMode::Hold.code(),
        burr_mode: BurrMode::Speed.code(),
        burr_speed_rad_per_s: 500.0,
        ..Command::zeroed()
    };
    command.tendon_force_n[..2].copy_from_slice(&tension_n);
    command
}

fn names(texts: &[&str]) -> Vec<String> {
    texts.iter().map(|text| (*text).to_owned()).collect()
}

fn linear(sim: &mut Sim, command: &Command) -> LinearModel {
    let outputs = names(&["t_world_burr.position_m", "tendon_tension_n", "bend_rad"]);
    sim.linearize(&[*command], &names(&["tendon_force_n"]), &outputs).unwrap()
}

fn matrix(rows: usize, entries: &[f64]) -> DMatrix<f64> {
    DMatrix::from_row_slice(rows, entries.len() / rows.max(1), entries)
}

/// Scenes that between them have every entry that a vector can have.
const MODELS: [&str; 7] = [
    "manipulator = { model = \"constant_curvature\" }",
    "manipulator = { model = \"modal\" }",
    "manipulator = { model = \"planar\", tendon_friction = 0.2 }",
    "manipulator = { model = \"spatial\", links = 6 }",
    "manipulator = { model = \"full\", links = 4 }",
    "drilling = { side_force = true }",
    "[arm]\nmodel = \"ur5\"\n[arm.compliance]\njoint_stiffness_nm_per_rad = [1e4, 1e4, 1e4, 4e3, 4e3, 4e3]\n\
     joint_damping_nms_per_rad = [10.0, 10.0, 10.0, 4.0, 4.0, 4.0]",
];

#[test]
fn a_vector_holds_what_a_tick_integrates_and_restores_bit_for_bit() {
    for keys in MODELS {
        let mut sim = sim(keys);
        sim.step(&[pull([4.0, 1.0])], 40).unwrap();
        let here = sim.snapshot();
        let (vector, entries) = (here.vector().to_vec(), sim.state_entries());
        assert_eq!(vector.len(), entries.len(), "{keys}");
        sim.step(&[pull([4.0, 1.0])], 7).unwrap();
        let expected = sim.state().hash;
        sim.restore_vector(&here, &vector).unwrap();
        assert_eq!(sim.state(), here.state(), "{keys}: its own vector is the snapshot");
        sim.step(&[pull([4.0, 1.0])], 7).unwrap();
        assert_eq!(sim.state().hash, expected, "{keys}");
        for (index, entry) in entries.iter().enumerate() {
            let mut moved = vector.clone();
            moved[index] = (moved[index] + entry.difference).min(entry.range[1]);
            sim.restore_vector(&here, &moved).unwrap();
            let found = sim.snapshot();
            assert_eq!(found.vector(), moved, "{keys}: {}", entry.name);
            let is_moved = moved[index].to_bits() != vector[index].to_bits();
            assert_eq!(sim.state().hash != here.state().hash, is_moved, "{keys}: {}", entry.name);
            sim.step(&[pull([4.0, 1.0])], 1).unwrap();
        }
        let distinct: std::collections::BTreeSet<&str> = entries.iter().map(|it| it.name.as_str()).collect();
        assert_eq!(distinct.len(), entries.len(), "{keys}");
    }
}

#[test]
fn a_vector_that_does_not_fit_changes_nothing() {
    let mut sim = sim("manipulator = { tendon_friction = 0.2 }");
    let here = sim.snapshot();
    sim.step(&[pull([4.0, 1.0])], 5).unwrap();
    let before = *sim.state();
    let sliding = sim.state_entries().iter().position(|it| it.name == "tendon_0.sliding").unwrap();
    let mut cases = vec![(here.vector()[1..].to_vec(), "entries, expected")];
    for (index, value, part) in [(0, f64::NAN, "`mount.x` is NaN"), (sliding, 1.5, "expected -1 to 1")] {
        let mut vector = here.vector().to_vec();
        vector[index] = value;
        cases.push((vector, part));
    }
    for (vector, part) in cases {
        let error = sim.restore_vector(&here, &vector).unwrap_err().to_string();
        assert!(error.contains(part), "{error}");
        assert_eq!(*sim.state(), before);
    }
    // On a path the joints follow from it.
    let insert = Command {
        arm_mode: ArmMode::Insert.code(),
        arm_axis: [0.0, 0.0, 1.0],
        arm_depth_m: 0.01,
        arm_speed_m_per_s: 0.01,
        ..pull([4.0, 1.0])
    };
    sim.step(&[insert], 5).unwrap();
    let (here, before) = (sim.snapshot(), *sim.state());
    let joint = sim.state_entries().iter().position(|it| it.is_of_arm_joint()).unwrap();
    let mut vector = here.vector().to_vec();
    vector[joint] += 1e-6;
    let error = sim.restore_vector(&here, &vector).unwrap_err().to_string();
    assert!(error.contains("follows a path"), "{error}");
    assert_eq!(*sim.state(), before);
    let model = linear(&mut sim, &insert);
    assert!(model.notes.iter().any(|note| note.contains("follows a path")), "{:?}", model.notes);
}

/// At rest the tip follows the tensions by `C (I - A)⁻¹ B`.
#[test]
fn the_tip_jacobian_is_the_static_gain_of_the_tick() {
    for model in ["constant_curvature", "modal", "planar", "spatial", "full"] {
        let mut sim = sim(&format!(
            "manipulator = {{ model = \"{model}\", tendon_friction = 0.0, damping_ratio = 1.0 }}"
        ));
        let command = pull([6.0, 1.0]);
        sim.step(&[command], 1000).unwrap();
        let inputs = names(&["tendon_force_n"]);
        let linear = sim.linearize(&[command], &inputs, &names(&["t_world_tip.position_m"])).unwrap();
        let (n, m) = (linear.states.len(), linear.inputs.len());
        let of_tool = |at: &usize| {
            let of = ["mount", "bend", "mode", "flexure"];
            of.iter().any(|part| linear.states[*at].name.starts_with(part))
        };
        // The arm's joints keep their positions: their own gain is infinite.
        let tool: Vec<usize> = (0..n).filter(of_tool).collect();
        let a = matrix(n, &linear.a).select_rows(&tool).select_columns(&tool);
        let b = matrix(n, &linear.b).select_rows(&tool);
        let held = (DMatrix::identity(tool.len(), tool.len()) - a).lu().solve(&b).unwrap();
        let gain = matrix(3, &linear.c).select_columns(&tool) * held;
        let (own, state) = (sim.tip_jacobian(), *sim.state());
        let own_gain = DMatrix::from_fn(3, m, |row, tendon| own.per_tension[row * 4 + tendon]);
        let error = (&own_gain - &gain).amax() / gain.amax();
        println!("{model}: {:.3e} m/N, error {error:.1e}", gain.amax());
        assert!(own.tick == 1000 && error < 1e-6, "{model}: {own_gain} {gain}");
        // In free space the tip moves rigidly with the base, and the compliance is symmetric.
        let lever: [f64; 3] =
            core::array::from_fn(|k| state.t_world_tip.position_m[k] - state.t_world_base.position_m[k]);
        let rigid = [0.0, lever[2], -lever[1], -lever[2], 0.0, lever[0], lever[1], -lever[0], 0.0];
        for (at, rigid) in rigid.iter().enumerate() {
            let (row, k) = (at / 3, at % 3);
            assert!((own.per_base[row * 6 + 3 + k] - rigid).abs() < 1e-12, "{model}: {row} {k}");
            let (one, other) = (own.compliance[row * 6 + 3 + k], own.compliance[(3 + k) * 6 + row]);
            assert!((one - other).abs() < 1e-9 * own.compliance[6 * 4 + 4].abs().max(1.0), "{model}");
        }
    }
}

/// Takes the same derivatives from outside, with other differences.
fn by_hand(sim: &mut Sim, command: &Command, output: impl Fn(&Sim) -> f64) -> [DMatrix<f64>; 3] {
    let here = sim.snapshot();
    let (x, entries) = (here.vector().to_vec(), sim.state_entries());
    let mut a = DMatrix::zeros(x.len(), x.len());
    let mut c = DMatrix::zeros(1, x.len());
    for (j, entry) in entries.iter().enumerate().filter(|(_, entry)| !entry.is_of_plan()) {
        let step = 3.0 * entry.difference;
        let sides = [-step, step].map(|step| {
            let mut moved = x.clone();
            moved[j] = (x[j] + step).clamp(entry.range[0], entry.range[1]);
            sim.restore_vector(&here, &moved).unwrap();
            let seen = output(sim);
            sim.step(&[*command], 1).unwrap();
            (moved[j], seen, DVector::from(sim.snapshot().vector().to_vec()))
        });
        let [(low, y_low, next_low), (high, y_high, next_high)] = sides;
        a.set_column(j, &((next_high - next_low) / (high - low)));
        c[(0, j)] = (y_high - y_low) / (high - low);
    }
    let sides = [-3e-4, 3e-4].map(|step| {
        sim.restore(&here).unwrap();
        let mut moved = *command;
        moved.tendon_force_n[0] += step;
        sim.step(&[moved], 1).unwrap();
        DVector::from(sim.snapshot().vector().to_vec())
    });
    let b = (&sides[1] - &sides[0]) / 6e-4;
    sim.restore(&here).unwrap();
    [a, DMatrix::from_column_slice(x.len(), 1, b.as_slice()), c]
}

/// Largest difference of each entry, as a share of the largest of its row in either.
fn worst(a: &DMatrix<f64>, b: &DMatrix<f64>) -> f64 {
    let rows = a.row_iter().zip(b.row_iter());
    let of = rows.map(|(a, b)| (a - b).amax() / a.amax().max(b.amax()).max(1e-9));
    of.fold(0.0, f64::max)
}

#[test]
fn matrices_are_the_differences_that_one_takes_by_hand() {
    for keys in MODELS {
        let mut sim = sim(keys);
        let command = pull([4.0, 1.0]);
        sim.step(&[command], 40).unwrap();
        let before = *sim.state();
        let model = linear(&mut sim, &command);
        assert_eq!(*sim.state(), before, "{keys}: the simulation is as it was");
        let n = model.states.len();
        let [a, b, c] = by_hand(&mut sim, &command, |sim| sim.state().t_world_burr.position_m[0]);
        let (model_b, model_c) = (matrix(n, &model.b), matrix(model.outputs.len(), &model.c));
        let errors = [
            worst(&matrix(n, &model.a), &a),
            worst(&model_b.columns(0, 1).into_owned(), &b),
            worst(&model_c.rows(0, 1).into_owned(), &c),
        ];
        println!("{keys}: {n} states, worst A, B, C {errors:.1?}, notes {:?}", model.notes);
        // Both are differences: what is left is rounding over the difference, and the tick's curvature.
        assert!(errors.iter().all(|error| *error < 1e-4), "{keys}: {errors:?}");
        // A tension is the command's own; poses do not depend on this tick's command.
        let names: Vec<&str> = model.outputs.iter().map(|it| it.name.as_str()).collect();
        let d = matrix(model.outputs.len(), &model.d);
        let at = |name: &str| names.iter().position(|it| *it == name).unwrap();
        assert!((d[(at("tendon_tension_n[0]"), 0)] - 1.0).abs() < 1e-9, "{keys}");
        assert_eq!(d[(at("t_world_burr.position_m[0]"), 0)], 0.0, "{keys}");
    }
}

/// The burr lies on a fixed block, which resists the bend.
const CONTACT: &str = "[[body]]\nname = \"block\"\nmotion = \"fixed\"\nposition_mm = [14.0, 0.0, 0.0]\n\
                       [body.cuboid]\nhalf_extents_mm = [10.0, 20.0, 20.0]\n";

#[test]
fn a_contact_is_part_of_the_model_and_a_changing_one_is_said() {
    let mut sim = sim(CONTACT);
    let command = pull([6.0, 1.0]);
    sim.step(&[command], 400).unwrap();
    assert!(sim.state().contact_count > 0 && sim.state().burr_force_n + sim.state().wall_force_n > 0.1);
    let model = linear(&mut sim, &command);
    let mut free = self::sim("");
    free.step(&[command], 400).unwrap();
    let free = linear(&mut free, &command);
    let n = model.states.len();
    // The tip's answer to the tension after a few ticks: the block takes nearly all of it.
    let answer = |model: &LinearModel| {
        let (a, b) = (matrix(n, &model.a), matrix(n, &model.b));
        let mut x = b.column(0).into_owned();
        for _ in 0..200 {
            x = &a * x + b.column(0);
        }
        (matrix(model.outputs.len(), &model.c) * x)[0]
    };
    let (held, moved) = (answer(&model), answer(&free));
    // What the simulation does with 0.05 N more, in 200 ticks.
    let before = sim.state().t_world_burr.position_m[0];
    sim.step(&[pull([6.05, 1.0])], 201).unwrap();
    let seen = (sim.state().t_world_burr.position_m[0] - before) / 0.05;
    println!("tip per tension: held {held:.3e}, free {moved:.3e}, simulated {seen:.3e} m/N");
    assert!(held.abs() < 0.05 * moved.abs());
    assert!((held - seen).abs() < 0.05 * held.abs().max(1e-6), "{held} {seen}");
    assert!(model.notes.is_empty(), "{:?}", model.notes);
    // At the touch itself the derivative is the mean of two, which the model says.
    let mut touching = self::sim(CONTACT);
    let (mut said, mut earlier) = (false, touching.snapshot());
    for _ in 0..400 {
        let here = touching.snapshot();
        touching.step(&[command], 1).unwrap();
        if touching.state().contact_count > 0 {
            // Between the last state whose tick is free and the first whose tick is not is one that touches.
            let (from, to) = (earlier.vector().to_vec(), here.vector().to_vec());
            let forces = names(&["burr_force_n", "wall_force_n"]);
            let (mut low, mut high) = (0.0, 1.0);
            while !said && high - low > 1e-15 {
                let middle = 0.5 * (low + high);
                let x: Vec<f64> = from.iter().zip(&to).map(|(a, b)| a + middle * (b - a)).collect();
                touching.restore_vector(&here, &x).unwrap();
                let model = touching.linearize(&[command], &[], &forces).unwrap();
                said = model.notes.iter().any(|note| note.contains("contacts change"));
                if model.output.iter().sum::<f64>() > 0.0 { high = middle } else { low = middle }
            }
            break;
        }
        earlier = here;
    }
    assert!(said);
}

/// A block in front of the burr.
const BLOCK: &str = "name = \"a\"\nrun = { mode = \"lockstep\", duration_s = 10.0 }\n[volume]\nphantom = \"block\"\n\
                     spacing_mm = 1.0\n[tool]\nburr_start_mm = [0.0, 0.0, -31.0]\ndirection = [0.0, 0.0, 1.0]\n\
                     bend_toward = [1.0, 0.0, 0.0]\n[[controller]]\nname = \"test\"\n\
                     drives = [\"tendon\", \"arm\", \"burr\"]\nexternal = true\n";

#[test]
fn drilling_goes_on_as_if_no_model_had_been_taken() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("scene.toml");
    std::fs::write(&file, BLOCK).unwrap();
    let shared = SharedScene::load(Some(&file), &[], None).unwrap();
    let mut sims = [0, 1].map(|_| Sim::new(&shared, &Drive::Nothing).unwrap());
    let feed = Command {
        arm_mode: ArmMode::Insert.code(),
        arm_axis: [0.0, 0.0, 1.0],
        arm_depth_m: 0.01,
        arm_speed_m_per_s: 0.01,
        burr_speed_rad_per_s: 800.0,
        ..pull([3.0, 1.0])
    };
    let mut models = Vec::new();
    for tick in 0..300 {
        sims.iter_mut().for_each(|sim| sim.step(&[feed], 1).unwrap());
        if tick % 100 == 99 {
            let before = *sims[0].state();
            models.push(linear(&mut sims[0], &feed));
            assert_eq!(*sims[0].state(), before);
            assert_eq!(
                linear(&mut sims[0], &feed),
                models[models.len() - 1],
                "a function of state and command"
            );
        }
    }
    assert!(sims[1].state().burr_force_n > 0.0 && !sims[1].drilled().is_empty());
    assert_eq!(sims[0].state(), sims[1].state());
    assert_eq!(sims[0].drilled(), sims[1].drilled());
    assert!(models[2].a != models[0].a && models[2].output.iter().all(|y| y.is_finite()));
}

#[test]
fn unknown_signals_are_refused_by_name() {
    let mut sim = sim("");
    let refused = |sim: &mut Sim, inputs: &[&str], outputs: &[&str]| match sim.linearize(
        &[pull([1.0, 1.0])],
        &names(inputs),
        &names(outputs),
    ) {
        Err(error @ SimError::NoSignal { .. }) => error.to_string(),
        other => panic!("{other:?}"),
    };
    for (inputs, outputs, part) in [
        (&["tendon_forces"][..], &[][..], "input `tendon_forces`"),
        (&["tendon_mode"], &[], "whole number"),
        (&["tube_deployed_m"], &[], "no controller"),
        (&[], &["tick"], "whole number"),
        (&[], &["t_world_body"], "uses no element"),
    ] {
        let text = refused(&mut sim, inputs, outputs);
        assert!(text.contains(part), "{text}");
    }
    let model = sim.linearize(&[pull([1.0, 1.0])], &names(&["tendon_displacement_m[0]"]), &[]).unwrap();
    assert!(model.notes.iter().any(|note| note.contains("no effect")), "{:?}", model.notes);
}

#[test]
fn a_batch_gives_each_simulations_own_model() {
    let shared = scene("manipulator = { links = 6 }");
    let batch = Batch::new(&vec![shared; 3], &Drive::Nothing, 2).unwrap();
    let commands: Vec<Command> = (0..3).map(|i| pull([f64::from(i), 0.0])).collect();
    batch.step(Some(commands.clone()), 30).unwrap();
    let (inputs, outputs) = (names(&["tendon_force_n"]), names(&["bend_rad"]));
    let models = batch.linearize_watched(Some(commands.clone()), &inputs, &outputs, &mut || ()).unwrap();
    for (index, (model, command)) in models.iter().zip(commands).enumerate() {
        let (inputs, outputs) = (inputs.clone(), outputs.clone());
        let alone = batch.with(index, move |sim| sim.linearize(&[command], &inputs, &outputs)).unwrap();
        assert_eq!(*model, alone);
    }
    assert_ne!(models[0].a, models[2].a);
}

/// Returns the rows and columns of a model's states whose names have one of these beginnings.
fn part(model: &LinearModel, beginnings: &[&str]) -> (Vec<usize>, DMatrix<f64>, DMatrix<f64>) {
    let is_in = |name: &str| beginnings.iter().any(|beginning| name.starts_with(beginning));
    let kept: Vec<usize> = (0..model.states.len()).filter(|i| is_in(&model.states[*i].name)).collect();
    let n = model.states.len();
    let (a, b) = (matrix(n, &model.a), matrix(n, &model.b));
    (kept.clone(), a.select_rows(&kept).select_columns(&kept), b.select_rows(&kept))
}

/// MuJoCo has no stiffness in its implicit operator, so what is compared is what both discretise. Ours solves
/// `(M + h D + h² K) Δv = -h (K (q + h v) + D v) + h τ`, so at rest `A_vv = W⁻¹ M`, `A_vq = -h W⁻¹ K` and
/// `B_v = h W⁻¹ τ'`, with W the operator: `A_vv⁻¹` of both gives `M⁻¹ K` and `M⁻¹ τ'`, and `M⁻¹ D` follows.
#[test]
fn the_free_chain_is_mujocos() {
    let Some(python) = python::or_skip("mujoco-1", &["mujoco==3.3.7"], "mujoco") else { return };
    let shared =
        scene("manipulator = { model = \"planar\", links = 8, integrator = \"linearly_implicit_euler\" }");
    let mut sim = Sim::new(&shared, &Drive::Nothing).unwrap();
    let model = linear(&mut sim, &pull([0.0, 0.0]));
    let (_, a, b) = part(&model, &["mount.", "flexure_"]);
    let half = a.nrows() / 2;
    let h = model.dt_s;
    let inverse = a.view((half, half), (half, half)).into_owned().try_inverse().unwrap();
    let stiffness = -(&inverse * a.view((half, 0), (half, half))) / h;
    let damping = (&inverse - DMatrix::identity(half, half)) / h - &stiffness * h;
    let pull = &inverse * b.view((half, 0), (half, 1)) / h;
    let p = manipulator_parameters(shared.scene()).unwrap();
    let base = BaseMotion::at_rest(nalgebra::Isometry3::identity());
    let tool = AnyManipulator::new(Rung::Planar, p.clone(), &base).unwrap();
    let damping_s = p.damping_ratio / (core::f64::consts::PI * tool.first_natural_frequency_hz());
    let given = serde_json::json!({
        "joints_m": p.joint_positions_m, "stiffness": p.joint_stiffness_nm_per_rad, "tip_m": p.tip_offset_m,
        "damping_s": damping_s, "density": p.linear_density_kg_per_m, "radii_m": p.tube_radii_m,
        "burr": [p.burr_mass_kg, p.cutter.only_radius_m().unwrap()],
        "shaft": [p.shaft_mass_kg, p.shaft_centre_m],
        "mount": p.mount_stiffness_n_per_m[0], "mount_ratio": p.mount_damping_ratio,
        "tendon_m": p.tendon.offset_m,
        "ours": [stiffness.transpose().as_slice(), damping.transpose().as_slice(), pull.as_slice()],
    });
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/linear_mujoco.py");
    let mut child =
        Program::new(python).arg(script).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    child.stdin.take().unwrap().write_all(given.to_string().as_bytes()).unwrap();
    let output = limited_output_of(child, COMMAND_LIMIT, "linear_mujoco.py");
    assert!(output.status.success());
    let errors: Vec<f64> = serde_json::from_slice(&output.stdout).unwrap();
    println!("worst of K, D, tendon as shares of their rows: {errors:.1?}");
    assert!(errors.len() == 3 && errors.iter().all(|error| *error < 1e-4), "{errors:?}");
}

/// Solves the discrete Riccati equation by doubling (Chu, Fan and Lin, 2005) and returns the feedback.
fn regulator(a: &DMatrix<f64>, b: &DMatrix<f64>, q: &DMatrix<f64>, r: f64) -> DMatrix<f64> {
    let unit = DMatrix::identity(a.nrows(), a.nrows());
    let (mut power, mut g, mut p) = (a.clone(), b * b.transpose() / r, q.clone());
    for _ in 0..40 {
        let between = (&unit + &g * &p).try_inverse().unwrap();
        let next = &p + power.transpose() * &p * &between * &power;
        g = &g + &power * &between * &g * power.transpose();
        power = &power * &between * &power;
        let change = (&next - &p).amax() / next.amax();
        p = next;
        if change < 1e-13 {
            break;
        }
    }
    let scale = (b.transpose() * &p * b)[0] + r;
    b.transpose() * &p * a / scale
}

/// Returns the eigenvector of an eigenvalue by inverse iteration.
fn eigenvector(matrix: &DMatrix<f64>, value: Complex<f64>) -> DVector<Complex<f64>> {
    let n = matrix.nrows();
    let near = value * 1.000_000_1;
    let shifted = matrix.map(|x| Complex::new(x, 0.0)) - DMatrix::identity(n, n) * near;
    let factored = shifted.lu();
    let mut vector = DVector::from_element(n, Complex::new(1.0, 0.3));
    for _ in 0..6 {
        vector = factored.solve(&vector).unwrap();
        vector /= Complex::new(vector.norm(), 0.0);
    }
    vector
}

/// A linear-quadratic regulator of the tip, designed on the model, gives the simulation the poles of the
/// design.
#[test]
fn a_designed_regulator_has_its_poles_in_the_simulation() {
    let mut sim = sim("manipulator = { links = 8, damping_ratio = 0.02 }");
    let mut command = pull([8.0, 8.0]);
    sim.step(&[command], 20).unwrap();
    let model = linear(&mut sim, &command);
    let (kept, a, b) = part(&model, &["mount.", "flexure_"]);
    let b = b.columns(0, 1).into_owned();
    let n = model.states.len();
    let c = matrix(model.outputs.len(), &model.c).rows(0, 1).into_owned().select_columns(&kept);
    assert_eq!(n, model.state.len());
    let weight = c.transpose() * &c * 1e5 + DMatrix::identity(kept.len(), kept.len()) * 1e-9;
    let gain = regulator(&a, &b, &weight, 1e-3);
    let closed = &a - &b * &gain;
    let slowest = |matrix: &DMatrix<f64>| {
        let all = matrix.complex_eigenvalues();
        *all.iter().filter(|z| z.im > 1e-6).max_by(|a, b| a.norm().total_cmp(&b.norm())).unwrap()
    };
    let (open_pole, pole) = (slowest(&a), slowest(&closed));
    let rate = |pole: Complex<f64>| pole.ln() / model.dt_s;
    println!("slowest pole: open {:.1}, designed {:.1} 1/s", rate(open_pole), rate(pole));
    assert!(rate(pole).re < 1.3 * rate(open_pole).re, "the regulator damps the tool");
    let (right, left) = (eigenvector(&closed, pole), eigenvector(&closed.transpose(), pole));
    // Starts in the mode, 0.02 mm of tip.
    let shape = right.map(|x| x.re);
    let scale = 2e-5 / (&c * &shape)[0].abs();
    let x0 = DVector::from(model.state.clone());
    let mut start = model.state.clone();
    for (place, entry) in kept.iter().zip(shape.iter()) {
        start[*place] += scale * entry;
    }
    let here = sim.snapshot();
    sim.restore_vector(&here, &start).unwrap();
    let (mut course, mut most_n): (Vec<Complex<f64>>, f64) = (Vec::new(), 0.0);
    for _ in 0..40 {
        let x = DVector::from(sim.snapshot().vector().to_vec()) - &x0;
        let x = DVector::from_iterator(kept.len(), kept.iter().map(|place| x[*place]));
        course.push(left.iter().zip(x.iter()).map(|(l, x)| l * *x).sum());
        let more_n = -(&gain * &x)[0];
        most_n = most_n.max(more_n.abs());
        command.tendon_force_n[0] = 8.0 + more_n;
        sim.step(&[command], 1).unwrap();
    }
    println!("at most {most_n:.2} N of 8 N");
    assert!(most_n < 4.0, "{most_n}: no tendon goes slack");
    let (mut above, mut below) = (Complex::new(0.0, 0.0), 0.0);
    for pair in course.windows(2) {
        above += pair[1] * pair[0].conj();
        below += pair[0].norm_sqr();
    }
    let seen = above / below;
    let error = (rate(seen) - rate(pole)).norm() / rate(pole).norm();
    println!("simulated {:.1} 1/s, error {:.2} %", rate(seen), 100.0 * error);
    assert!(error < 0.02, "{error}");
}

/// A wrench moves a free body by `F dt^2 / m` times 10/16, the sum of four substeps; its pose is an output of
/// the tick.
#[test]
fn the_pose_of_a_body_answers_its_wrench_within_the_tick() {
    let mut sim = sim("[[body]]\nname = \"ball\"\nball = { radius_mm = 5.0 }\nmotion = \"free\"\n\
         position_mm = [100.0, 0.0, 0.0]\n\
         [[controller]]\nname = \"push\"\ndrives = [\"body\"]\nbody = \"ball\"\nexternal = true\n");
    let push = Command { body_mode: BodyMode::ServoCf.code(), ..Command::zeroed() };
    let (inputs, outputs) = (names(&["body_wrench.force_n"]), names(&["t_world_body[0].position_m"]));
    let model = sim.linearize(&[pull([4.0, 1.0]), push], &inputs, &outputs).unwrap();
    let mass_kg = 1900.0 * 4.0 / 3.0 * std::f64::consts::PI * 0.005_f64.powi(3);
    let off = matrix(3, &model.d) / (1e-6 / mass_kg * 10.0 / 16.0) - DMatrix::identity(3, 3);
    println!(
        "derivative of the position by the force, relative to the closed form: off by {:.1e}",
        off.amax()
    );
    assert!(off.amax() < 1e-6, "{off}");
}
