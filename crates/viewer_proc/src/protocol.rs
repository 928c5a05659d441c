//! The Foxglove WebSocket protocol: text messages, binary messages and their numbers.
//!
//! Source: the protocol's specification, `foxglove.websocket.v1` and its successor `foxglove.sdk.v1`, which
//! agree on everything used here.

use serde::{Deserialize, Serialize};

/// Supported subprotocols, preferred one first.
pub const SUBPROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];

const MESSAGE_DATA: u8 = 1;
const TIME: u8 = 2;
const SERVICE_RESPONSE: u8 = 3;
const SERVICE_REQUEST: u8 = 2;

/// Level of a status message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Level {
    /// Information.
    Info = 0,
    /// Something was dropped or refused.
    Warning = 1,
    /// The connection ends, or the request cannot be served.
    Error = 2,
}

/// A channel's advertisement.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Advertisement {
    /// Number of the channel, from 1.
    pub id: u32,
    /// Topic.
    pub topic: String,
    /// `cdr`, `json`, or one of our own.
    pub encoding: String,
    /// Name of the schema.
    pub schema_name: String,
    /// Text of the schema, as in the logs.
    pub schema: String,
    /// `ros2msg`, `jsonschema`, or empty.
    pub schema_encoding: String,
}

/// A client's text message.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(tag = "op", rename_all = "camelCase")]
pub enum ClientText {
    /// Subscribes to channels.
    Subscribe {
        /// The subscriptions.
        subscriptions: Vec<Subscription>,
    },
    /// Ends subscriptions.
    #[serde(rename_all = "camelCase")]
    Unsubscribe {
        /// Numbers chosen by the client.
        subscription_ids: Vec<u32>,
    },
    /// Any other message of the protocol, which the server does not support.
    #[serde(other)]
    Other,
}

/// A client's request for one subscription.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Subscription {
    /// Number chosen by the client.
    pub id: u32,
    /// The channel's number.
    pub channel_id: u32,
    /// Whether the client wants only the newest messages of a stream, at most 30 times a second; not part of
    /// the Foxglove protocol.
    #[serde(default)]
    pub newest: bool,
}

/// A client's service call.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServiceCall<'a> {
    /// The service's number.
    pub service: u32,
    /// Chosen by the client; repeated in the response.
    pub call: u32,
    /// Must be `json`.
    pub encoding: &'a str,
    /// The request.
    pub payload: &'a [u8],
}

/// The first message to a client.
pub fn server_info(name: &str, session: &str) -> String {
    serde_json::json!({
        "op": "serverInfo", "name": name, "capabilities": ["time", "services"],
        "supportedEncodings": ["json"],
        "metadata": {"program": "trabecula", "version": env!("CARGO_PKG_VERSION")}, "sessionId": session,
    })
    .to_string()
}

/// Advertises the channels.
pub fn advertise(channels: &[Advertisement]) -> String {
    serde_json::json!({"op": "advertise", "channels": channels}).to_string()
}

/// Advertises the services; their numbers start at 1 in this order.
pub fn advertise_services(names: &[&str]) -> String {
    let service = |(i, name): (usize, &&str)| {
        let half = |what: &str| {
            serde_json::json!({"encoding": "json", "schemaName": format!("trabecula.view{name}.{what}"),
                "schemaEncoding": "jsonschema", "schema": "{\"type\":\"object\"}"})
        };
        serde_json::json!({"id": i + 1, "name": name, "type": format!("trabecula.view{name}"),
            "request": half("request"), "response": half("response")})
    };
    let services: Vec<serde_json::Value> = names.iter().enumerate().map(service).collect();
    serde_json::json!({"op": "advertiseServices", "services": services}).to_string()
}

/// A status message for the user.
pub fn status(level: Level, message: &str) -> String {
    serde_json::json!({"op": "status", "level": level as u8, "message": message}).to_string()
}

/// The response to a call that could not be processed at all.
pub fn service_failure(call: &ServiceCall<'_>, message: &str) -> String {
    serde_json::json!({"op": "serviceCallFailure", "serviceId": call.service, "callId": call.call,
        "message": message})
    .to_string()
}

/// A channel message: subscription, log time in ns, payload.
pub fn message_data(subscription: u32, time_ns: u64, payload: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(13 + payload.len());
    bytes.push(MESSAGE_DATA);
    bytes.extend_from_slice(&subscription.to_le_bytes());
    bytes.extend_from_slice(&time_ns.to_le_bytes());
    bytes.extend_from_slice(payload);
    bytes
}

/// The simulated time.
pub fn time(time_ns: u64) -> Vec<u8> {
    let mut bytes = vec![TIME];
    bytes.extend_from_slice(&time_ns.to_le_bytes());
    bytes
}

/// The response to a call.
pub fn service_response(service: u32, call: u32, encoding: &str, payload: &[u8]) -> Vec<u8> {
    let mut bytes = vec![SERVICE_RESPONSE];
    for word in [service, call, encoding.len() as u32] {
        bytes.extend_from_slice(&word.to_le_bytes());
    }
    bytes.extend_from_slice(encoding.as_bytes());
    bytes.extend_from_slice(payload);
    bytes
}

/// Parses a client's binary message; `None` if it is not a service call.
pub fn service_call(bytes: &[u8]) -> Option<ServiceCall<'_>> {
    let rest = bytes.strip_prefix(&[SERVICE_REQUEST])?;
    let word = |at: usize| Some(u32::from_le_bytes(rest.get(at..at + 4)?.try_into().ok()?));
    let (service, call, length) = (word(0)?, word(4)?, word(8)? as usize);
    let end = length.checked_add(12)?;
    let encoding = std::str::from_utf8(rest.get(12..end)?).ok()?;
    Some(ServiceCall { service, call, encoding, payload: &rest[end..] })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_call_is_read_and_no_cut_of_it_is() {
        let mut bytes = vec![2];
        for word in [3u32, 9, 4] {
            bytes.extend_from_slice(&word.to_le_bytes());
        }
        let head = bytes.len() + 4;
        bytes.extend_from_slice(b"json{}");
        let call = ServiceCall { service: 3, call: 9, encoding: "json", payload: b"{}" };
        assert_eq!(service_call(&bytes), Some(call));
        for cut in 0..head {
            assert_eq!(service_call(&bytes[..cut]), None, "{cut}");
        }
        bytes[9..13].copy_from_slice(&u32::MAX.to_le_bytes());
        assert_eq!(service_call(&bytes), None, "a length beyond the message");
    }

    #[test]
    fn client_texts_are_read() {
        let text = r#"{"op":"subscribe","subscriptions":[{"id":5,"channelId":2},{"id":6,"channelId":3,"newest":true}]}"#;
        let subscriptions = vec![
            Subscription { id: 5, channel_id: 2, newest: false },
            Subscription { id: 6, channel_id: 3, newest: true },
        ];
        assert_eq!(
            serde_json::from_str::<ClientText>(text).unwrap(),
            ClientText::Subscribe { subscriptions }
        );
        let text = r#"{"op":"unsubscribe","subscriptionIds":[5]}"#;
        let expected = ClientText::Unsubscribe { subscription_ids: vec![5] };
        assert_eq!(serde_json::from_str::<ClientText>(text).unwrap(), expected);
        let text = r#"{"op":"getParameters","id":"1","parameterNames":[]}"#;
        assert_eq!(serde_json::from_str::<ClientText>(text).unwrap(), ClientText::Other);
    }
}
