//! Messages from a browser to the viewer: the head of a request, texts and calls of the WebSocket protocol.

use std::cell::OnceCell;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::time::Duration;

use viewer_proc::board::Board;
use viewer_proc::channels::Channels;
use viewer_proc::log::player::Player;
use viewer_proc::protocol::{ClientText, service_call, service_failure};
use viewer_proc::server::http::{Origins, Reach, parse, websocket_answer};
use viewer_proc::services::{Reply, Request, read_request, response};

const TOKEN: &str = "t";
const ADDRESS: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 8765);

thread_local! {
    static BOARD: OnceCell<Board> = const { OnceCell::new() };
}

/// Reads one message as each kind that a client may send.
pub fn viewer(data: &[u8]) {
    request_head(data);
    if let Ok(text) = std::str::from_utf8(data)
        && let Ok(text) = serde_json::from_str::<ClientText>(text)
    {
        subscribe(text);
    }
    if let Some(call) = service_call(data) {
        assert!(!service_failure(&call, "no").is_empty());
        obey(call.service, call.payload);
    }
    (0..=5).for_each(|service| obey(service, data));
}

fn request_head(data: &[u8]) {
    let Ok(Some(head)) = parse(data) else { return };
    assert!(data.ends_with(&head.rest));
    let hosts = "tunnel.example:9000".parse().into_iter().collect();
    let origins = Origins { allowed: vec!["http://studio.example".to_owned()], hosts };
    let own = origins.check(&head, ADDRESS, Reach::Loopback).is_ok();
    assert!(!own || origins.check(&head, ADDRESS, Reach::Network).is_ok());
    if let Ok(answer) = websocket_answer(&head) {
        assert_eq!(answer.matches("\r\n\r\n").count(), 1, "an answer with a head inside");
    }
    let _ = viewer_proc::assets::asset(&head.path, None);
}

fn subscribe(text: ClientText) {
    BOARD.with(|board| {
        let board = board.get_or_init(|| Board::new(Channels::new(&["a".to_owned()], false)));
        let client = board.join();
        match text {
            ClientText::Subscribe { subscriptions } => {
                for wanted in subscriptions {
                    let _ = board.subscribe(&client, wanted);
                }
            }
            ClientText::Unsubscribe { subscription_ids } => {
                for id in subscription_ids {
                    let _ = board.unsubscribe(&client, id);
                }
            }
            ClientText::Other => {}
        }
        client.take(1 << 20);
        board.leave(&client);
    });
}

fn obey(service: u32, payload: &[u8]) {
    let request = read_request(service, payload, TOKEN);
    if let Ok(Request::Playback(playback)) = &request {
        let mut player = Player::new(1_000, 9_000_000_000, 1_000_000, Vec::new());
        let outcome = player.apply(playback).map(|()| Reply::Done);
        player.advance(Duration::from_millis(40));
        assert!((1_000..=9_000_000_000).contains(&player.time_ns()));
        assert!(!response(outcome).1.is_empty());
    }
}

/// Seeds: requests as sent by browsers and the page.
pub fn seeds() -> Vec<Vec<u8>> {
    let call = |service: u32, payload: &str| {
        let mut bytes = vec![2];
        for word in [service, 9, 4] {
            bytes.extend_from_slice(&word.to_le_bytes());
        }
        bytes.extend_from_slice(b"json");
        bytes.extend_from_slice(payload.as_bytes());
        bytes
    };
    let mut all = vec![
        call(1, r#"{"token":"t","action":"step","ticks":3}"#),
        call(2, r#"{"token":"t","tendon_n":[1,2],"insert_m_per_s":0.01,"burr_rad_per_s":100}"#),
        call(3, r#"{"token":"t","primary_angle_deg":30}"#),
    ];
    let texts = [
        r#"{"op":"subscribe","subscriptions":[{"id":5,"channelId":2},{"id":6,"channelId":1}]}"#,
        r#"{"op":"unsubscribe","subscriptionIds":[5]}"#,
        r#"{"op":"getParameters","id":"1","parameterNames":[]}"#,
        r#"{"token":"t","action":"speed","speed":0.5}"#,
        r#"{"token":"t","c_arm":{"primary_angle_deg":30,"secondary_angle_deg":-10}}"#,
        r#"{"token":"t","pose":{"position_m":[0,0,0],"orientation_xyzw":[0,0,0,1]}}"#,
        r#"{"token":"t","action":"seek","time_ns":5000000}"#,
        r#"{"token":"t","action":"play","speed":-2}"#,
        r#"{"token":"t","action":"step","ticks":-4}"#,
        r#"{"token":"t","action":"next","kind":"miss"}"#,
        r#"{"centre_m":[0,0,0.1],"right":[1,0,0],"down":[0,1,0],"side_m":[0.1,0.1],"columns":64,"rows":64}"#,
        "GET / HTTP/1.1\r\nHost: localhost:8765\r\n\r\n",
        "HEAD /app.js?a=1 HTTP/1.1\r\nHost: 127.0.0.1:8765\r\nOrigin: http://127.0.0.1:8765\r\n\r\n",
        "GET /ws HTTP/1.1\r\nHost: 127.0.0.1:8765\r\nConnection: keep-alive, Upgrade\r\nUpgrade: WebSocket\r\n\
         Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\
         Sec-WebSocket-Protocol: foxglove.websocket.v1\r\n\r\nrest",
    ];
    all.extend(texts.map(|text| text.as_bytes().to_vec()));
    all
}
