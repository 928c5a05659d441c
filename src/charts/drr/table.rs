//! The chart's numbers: `drr.csv`, and the table that is printed.

use std::fmt::Write;
use std::path::Path;

use super::Point;
use crate::failure::Failure;

/// Writes `drr.csv` and prints the table, the ratio to the peers, and the spectrum's errors.
pub fn write(
    folder: &Path,
    points: &[Point],
    stream_ms: &[f64; 2],
    spectrum: &[(f64, f64)],
) -> Result<(), Failure> {
    let mut csv =
        "method,coarseness,pose,threads,least_ms,median_ms,exact_rms,exact_max,siddon_rms,siddon_max\n"
            .to_owned();
    for p in points {
        // Writing to a String cannot fail.
        let _ = writeln!(
            csv,
            "{},{},{},{},{:.4},{:.4},{:.4e},{:.4e},{:.4e},{:.4e}",
            p.method,
            p.coarseness,
            p.pose,
            p.threads,
            p.least_ms,
            p.median_ms,
            p.exact.rms,
            p.exact.max,
            p.siddon.rms,
            p.siddon.max
        );
        say!(
            "{:14} 1/{} {:8} {} T  {:9.3} ms ({:9.3})  exact {:.2e} max {:.2e}  siddon {:.2e} max {:.2e}",
            p.method,
            p.coarseness,
            p.pose,
            p.threads,
            p.least_ms,
            p.median_ms,
            p.exact.rms,
            p.exact.max,
            p.siddon.rms,
            p.siddon.max
        );
    }
    say!("reading the finest volume once: {:.2} ms with 1 thread, {:.2} with 2", stream_ms[0], stream_ms[1]);
    for (tube_kv, error) in spectrum {
        say!("spectrum of {tube_kv} kV: the table errs by at most {error:.1e} in -ln I");
    }
    if let Some((method, ratio, peer)) = ratio_to_peers(points) {
        say!(
            "{method} is {ratio:.1} times the fastest peer of equal or larger error ({peer}; median of the poses)"
        );
    }
    let path = folder.join("drr.csv");
    std::fs::write(&path, csv)
        .map_err(|cause| Failure::failed(format!("{}: cannot be written ({cause})", path.display())))
}

/// Whether a method is somebody else's.
fn is_peer(point: &Point) -> bool {
    point.method.starts_with("peer:")
}

/// Best of our methods at full resolution with two threads: in each pose the fastest peer of equal or larger error against the closed
/// integrals over our time; the median of the poses.
fn ratio_to_peers(points: &[Point]) -> Option<(String, f64, String)> {
    let finest = points.iter().map(|p| p.coarseness).min()?;
    let at_full: Vec<&Point> = points.iter().filter(|p| p.coarseness == finest && p.threads == 2).collect();
    let mut methods: Vec<&str> = at_full.iter().filter(|p| !is_peer(p)).map(|p| p.method.as_str()).collect();
    methods.dedup();
    let ratio_of = |method: &str| {
        let mut ratios: Vec<(f64, &str)> = Vec::new();
        for own in at_full.iter().filter(|p| p.method == method) {
            let peers = at_full.iter().filter(|p| is_peer(p) && p.pose == own.pose);
            let slower = peers.filter(|p| p.exact.rms >= own.exact.rms);
            let fastest = slower.min_by(|a, b| a.least_ms.total_cmp(&b.least_ms))?;
            ratios.push((fastest.least_ms / own.least_ms, fastest.method.as_str()));
        }
        ratios.sort_by(|a, b| a.0.total_cmp(&b.0));
        ratios.get(ratios.len() / 2).map(|&(ratio, peer)| (method.to_owned(), ratio, peer.to_owned()))
    };
    methods.into_iter().filter_map(ratio_of).max_by(|a, b| a.1.total_cmp(&b.1))
}
