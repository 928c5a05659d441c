//! Measures the processor time of the recorder's writes: `O_DIRECT` against the page cache, alternating in one run.
//!
//! `cargo run --release -p recorder_proc --example disk_cost [megabytes] [rounds] [folder]`
//!
//! Each round writes the same bytes both ways: 300 kB every 100 ms of simulated time (the state lane), and an image of
//! 512 KiB 15 times a second, each flushed, as fast as the disk accepts them. The processor time is that of the whole
//! process and includes the copy into the buffers.
#![allow(clippy::expect_used, clippy::print_stdout, reason = "a measurement, not a part of the product")]

use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;

use recorder_proc::background::{BackgroundFile, BackgroundOptions};
use rustix::time::{ClockId, clock_gettime};

fn cpu_s() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

fn write(path: &Path, direct: bool, megabytes: usize) -> (f64, f64, bool) {
    let image = vec![0x5a_u8; 512 << 10];
    let states = vec![0x3c_u8; 300_000];
    let options = BackgroundOptions { direct, fresh: false, ..BackgroundOptions::RUN };
    let (cpu, began) = (cpu_s(), Instant::now());
    let mut file = BackgroundFile::create(path, options).expect("the folder is writable");
    let is_direct = file.is_direct();
    let mut bytes = 0;
    for tenth in 0.. {
        file.write_all(&states).and_then(|()| file.flush()).expect("there is space");
        bytes += states.len();
        for _ in 0..1 + tenth % 2 {
            file.write_all(&image).and_then(|()| file.flush()).expect("there is space");
            bytes += image.len();
        }
        if bytes >= megabytes * 1_000_000 {
            break;
        }
    }
    file.close().expect("there is space");
    let mb = bytes as f64 * 1e-6;
    ((cpu_s() - cpu) * 1e3 / mb, mb / began.elapsed().as_secs_f64(), is_direct)
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let megabytes = arguments.next().and_then(|text| text.parse().ok()).unwrap_or(200);
    let rounds: usize = arguments.next().and_then(|text| text.parse().ok()).unwrap_or(5);
    let folder = arguments.next().map_or_else(std::env::temp_dir, PathBuf::from);
    let path = folder.join("disk_cost.bin");
    println!("round | way | ms of processor per MB | MB/s");
    for round in 1..=rounds {
        for direct in [false, true] {
            let (cpu, speed, is_direct) = write(&path, direct, megabytes);
            let way = if is_direct { "direct" } else { "buffered" };
            println!("{round:5} | {way:8} | {cpu:6.3} | {speed:6.0}");
        }
    }
    let _ = std::fs::remove_file(&path);
}
