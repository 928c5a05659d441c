//! How long the page waits for a span of a log: asks a viewer that is already there for the fields that the page plots at first, over spans of
//! 12 s spread over the log, and prints the median and the longest time to the answer.
//!
//! `cargo run --release -p viewer_proc --example span_cost -- URL`, where `URL` is what `trabecula view LOG` printed. The log is of an hour, as
//! `long_log` makes one: the bins of a shorter one hold single ticks, and nothing is read from the file.

use std::error::Error;
use std::time::{Duration, Instant};

use futures_util::{SinkExt, StreamExt};
use serde_json::{Value, json};
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::{WebSocketStream, client_async};

const SPAN_NS: u64 = 12_000_000_000;
const SPANS: u64 = 21;
const COLUMNS: u32 = 1200;
/// The number of `/series`.
const SERIES: u32 = 5;
/// A log of an hour is read once, whole.
const READ_LIMIT: Duration = Duration::from_secs(300);

type Socket = WebSocketStream<TcpStream>;

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn Error>> {
    let url = std::env::args().nth(1).ok_or("expected: URL")?;
    let (address, token) = url
        .strip_prefix("http://")
        .and_then(|rest| rest.split_once("/#token="))
        .ok_or("expected a URL as the viewer prints it: http://HOST:PORT/#token=TOKEN")?;
    let mut request = format!("ws://{address}/ws?token={token}").into_client_request()?;
    request.headers_mut().insert("Sec-WebSocket-Protocol", "foxglove.sdk.v1".parse()?);
    let (mut socket, _) = client_async(request, TcpStream::connect(address).await?).await?;
    let begun = Instant::now();
    // The whole time, answered by bins, tells when the log has been read.
    while !ask(&mut socket, 0, u64::MAX / 2).await?["reading"].is_null() {
        if begun.elapsed() > READ_LIMIT {
            return Err("the log is still being read".into());
        }
        tokio::time::sleep(Duration::from_millis(500)).await;
    }
    println!("the log was read {:.1} s after the first request", begun.elapsed().as_secs_f64());
    let end_ns = end_of(&mut socket).await?;
    if end_ns < 20 * SPAN_NS {
        return Err(format!("the log has {:.0} s, expected an hour", end_ns as f64 * 1e-9).into());
    }
    let mut times_ms = Vec::new();
    for number in 0..SPANS {
        let from_ns = (end_ns - SPAN_NS) / SPANS * number;
        let asked = Instant::now();
        let answer = ask(&mut socket, from_ns, from_ns + SPAN_NS).await?;
        times_ms.push(asked.elapsed().as_secs_f64() * 1e3);
        let widths = answer["series"].as_array().ok_or("no series")?.iter().map(|line| &line["width_ns"]);
        if widths.clone().any(|width| *width != json!(1_000_000)) {
            return Err(format!("not tick by tick: {:?}", widths.collect::<Vec<_>>()).into());
        }
    }
    times_ms.sort_by(f64::total_cmp);
    println!(
        "a span of 12 s from the file, 6 fields: median {:.0} ms, longest {:.0} ms of {SPANS}",
        times_ms[times_ms.len() / 2],
        times_ms[times_ms.len() - 1]
    );
    Ok(())
}

/// The last time that has a value.
async fn end_of(socket: &mut Socket) -> Result<u64, Box<dyn Error>> {
    let (mut from_ns, mut span_ns) = (0, 1 << 46);
    while span_ns > SPAN_NS {
        let answer = ask(socket, from_ns, from_ns + span_ns).await?;
        let last = answer["series"][0]["at"].as_array().and_then(|at| at.last()).and_then(Value::as_u64);
        let Some(last) = last else { break };
        from_ns += span_ns / u64::from(COLUMNS) * last;
        span_ns /= u64::from(COLUMNS);
    }
    Ok(from_ns)
}

async fn ask(socket: &mut Socket, from_ns: u64, to_ns: u64) -> Result<Value, Box<dyn Error>> {
    let fields: Vec<Value> = [
        ("/state", "tendon_tension_n[0]"),
        ("/state", "tendon_tension_n[1]"),
        ("/state", "bend_rad"),
        ("/state", "burr_force_n"),
        ("/state", "burr_speed_rad_per_s"),
        ("/timing/tick", "step_ns"),
    ]
    .iter()
    .map(|(topic, field)| json!({"topic": topic, "field": field}))
    .collect();
    let body = json!({"fields": fields, "from_ns": from_ns, "to_ns": to_ns, "columns": COLUMNS}).to_string();
    let mut bytes = vec![2];
    [SERIES, 1, 4].iter().for_each(|word: &u32| bytes.extend_from_slice(&word.to_le_bytes()));
    bytes.extend_from_slice(b"json");
    bytes.extend_from_slice(body.as_bytes());
    socket.send(Message::binary(bytes)).await?;
    loop {
        let message = socket.next().await.ok_or("the viewer has gone")??;
        if let Message::Binary(bytes) = message
            && bytes.first() == Some(&3)
        {
            // Kind, service, call, length and name of the encoding: 13 and 4 bytes.
            return Ok(serde_json::from_slice(bytes.get(17..).ok_or("a short answer")?)?);
        }
    }
}
