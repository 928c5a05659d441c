//! The burr's distance from its target at the end, of curved drilling on the exact shape and on a measured one, over seeds.
//!
//! `cargo run --release -p sim --example measured_tip [SEEDS [SCENE [KEY=VALUE ...]]]`: by default 10 seeds of configs/examples/sensors.toml.

#![allow(clippy::print_stdout, reason = "it prints figures")]

use std::path::Path;

use sim::{Drive, SharedScene, Sim};

type Failure = Box<dyn std::error::Error + Send + Sync>;

/// Distance of the burr from the target at the end, and its largest on the side, mm.
fn miss_mm(scene: &Path, settings: &[String], seed: u64) -> Result<f64, Failure> {
    let shared = SharedScene::load(Some(scene), settings, Some(seed))?;
    let drilling = shared.scene().controller.iter().find_map(|entry| entry.curved_drilling.as_ref());
    let target_mm = drilling.and_then(|plan| plan.target_mm).ok_or("the scene drills to no `target_mm`")?;
    let mut sim = Sim::new(&shared, &Drive::Nothing)?;
    sim.step(&[], shared.scene().tick_count())?;
    let burr_m = sim.state().t_world_burr.position_m;
    let squares = burr_m.iter().zip(target_mm).map(|(burr_m, target_mm)| (burr_m * 1e3 - target_mm).powi(2));
    Ok(squares.sum::<f64>().sqrt())
}

fn line(name: &str, x: &[f64]) {
    let count = x.len() as f64;
    let mean = x.iter().sum::<f64>() / count;
    let deviation = (x.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (count - 1.0).max(1.0)).sqrt();
    let worst = x.iter().copied().fold(0.0, f64::max);
    println!(
        "{name:28} mean {mean:6.3} mm, deviation {deviation:6.3} mm, worst {worst:6.3} mm, {count} runs"
    );
}

fn main() -> Result<(), Failure> {
    let mut words = std::env::args().skip(1);
    let seeds: u64 = words.next().map_or(Ok(10), |word| word.parse())?;
    let scene = words.next().unwrap_or_else(|| "configs/examples/sensors.toml".to_owned());
    let settings: Vec<String> = words.collect();
    let scene = Path::new(&scene);
    // Without sensors the seed changes nothing.
    let exact = [settings.as_slice(), &["controller.0.sensors=[]".to_owned()]].concat();
    line("exact shape", &[miss_mm(scene, &exact, 0)?]);
    let half = |odd: u64| -> Result<Vec<f64>, Failure> {
        (0..seeds).filter(|seed| seed % 2 == odd).map(|seed| miss_mm(scene, &settings, seed)).collect()
    };
    let (mut all, others) = std::thread::scope(|scope| {
        let others = scope.spawn(|| half(1));
        (half(0), others.join())
    });
    let others = others.map_err(|_| "a simulation panicked")??;
    all.as_mut().map_err(|error| error.to_string())?.extend(others);
    line("measured shape", &all?);
    Ok(())
}
