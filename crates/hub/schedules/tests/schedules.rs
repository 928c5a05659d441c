//! A hundred thousand schedules; for more, run `cargo run --release -p hub_schedules -- --count 10000000`.

use std::time::Instant;

use hub_schedules::{SchedulePlan, play, run, shrink};

#[test]
fn the_hub_keeps_its_rules_in_a_hundred_thousand_schedules() {
    let began = Instant::now();
    let threads = std::thread::available_parallelism().map_or(1, usize::from) as u64;
    let summary = play(0, 100_000, threads);
    let wall_s = began.elapsed().as_secs_f64();
    let rate = summary.schedules as f64 / wall_s;
    println!("{summary:?} in {wall_s:.1} s on {threads} threads: {rate:.0} schedules a second");
    if let Some((seed, cause)) = summary.failure {
        let (least, least_cause) = shrink(&SchedulePlan::of(seed));
        panic!("seed {seed}: {cause}\nshrunk: {least_cause}\n{least:#?}");
    }
    let played = summary.played;
    // Schedules that fail at once would test nothing.
    assert!(played.ended * 10 > summary.schedules * 9, "{summary:?}");
    assert!(played.ticks > 20 * summary.schedules, "{summary:?}");
    assert!(played.logs_cut * 100 > summary.schedules, "{summary:?}");
    assert!(
        played.frames > 5 * summary.schedules && played.frames_refused > summary.schedules,
        "{summary:?}"
    );
    assert!(
        played.frames_seen > summary.schedules
            && played.watched > 10 * summary.schedules
            && played.dropped > summary.schedules,
        "{summary:?}"
    );
}

#[test]
fn a_seed_says_everything() {
    for seed in 0..300 {
        let plan = SchedulePlan::of(seed);
        assert_eq!(run(&plan), run(&plan), "seed {seed}");
    }
}
