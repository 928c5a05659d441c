//! Selection of a projector by its measured error.

use xray::Projector;
use xray::ladder::{Rung, choose, line_of, rungs};

#[test]
fn the_quickest_rung_that_keeps_the_error_is_chosen() {
    let rungs = rungs();
    assert!(rungs.len() >= 5 && rungs.windows(2).all(|pair| pair[0].frame_ms <= pair[1].frame_ms));
    for rung in &rungs {
        for wanted in [rung.error_rel, 1.001 * rung.error_rel + 1e-12, 0.999 * rung.error_rel] {
            let chosen = choose(wanted);
            assert!(chosen.error_rel <= wanted, "{wanted}: {chosen:?}");
            let quicker = rungs.iter().filter(|other| other.frame_ms < chosen.frame_ms);
            assert!(quicker.clone().all(|other| other.error_rel > wanted), "{wanted}: {chosen:?}");
        }
    }
    // Present values of the table: the preview's error is half a percent, that of the sums over slices two
    // thousandths.
    assert!(matches!(choose(0.1).projector, Projector::Preview { .. }));
    assert_eq!(choose(2e-3).projector, Projector::SliceOrdered { oversampling: 0.8, sharpen: true });
    assert_eq!(choose(1.64e-3).projector, Projector::SLICE_ORDERED);
    assert_eq!(choose(1e-3).projector, Projector::Siddon);
}

#[test]
fn a_rung_is_written_as_it_is_read() {
    let write = |rung: &Rung| line_of(rung.projector, rung.error_rel, rung.frame_ms).unwrap();
    let mut written: Vec<String> = rungs().iter().map(write).collect();
    let mut table: Vec<&str> = include_str!("../../src/rungs.csv").lines().skip(1).collect();
    written.sort();
    table.sort_unstable();
    assert_eq!(written, table);
    assert_eq!(line_of(Projector::SliceOrdered { oversampling: 1.0, sharpen: false }, 1e-3, 1.0), None);
}
