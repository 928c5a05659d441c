// A program as in an operating room, independent of Trabecula, with the OpenIGTLink project's own C++ library: it checks every
// message's CRC, records the newest of each kind, sends its token, pauses, resumes and stops the run, and sends an unknown
// command. Arguments: port, token. Prints its results as JSON.

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <functional>
#include <iostream>
#include <map>
#include <set>
#include <sstream>
#include <string>
#include <vector>

#include "igtlClientSocket.h"
#include "igtlImageMessage.h"
#include "igtlMessageHeader.h"
#include "igtlPointMessage.h"
#include "igtlPolyDataMessage.h"
#include "igtlStatusMessage.h"
#include "igtlStringMessage.h"
#include "igtlTransformMessage.h"

namespace {

const int LIMIT_S = 60;
const int RECEIVE_LIMIT_MS = 1000;

std::string numbers(const float *values, int count) {
  std::ostringstream out;
  out.precision(9);
  for (int i = 0; i < count; ++i) out << (i ? "," : "[") << values[i];
  return out.str() + "]";
}

std::string numbers(const igtl::Matrix4x4 &matrix) { return numbers(&matrix[0][0], 16); }

std::string quoted(const std::string &text) {
  std::string out = "\"";
  for (char c : text) {
    if (c == '"' || c == '\\') out += '\\';
    out += c;
  }
  return out + "\"";
}

struct Pose {
  std::string matrix;
  std::string time;
};

class Peer {
 public:
  explicit Peer(int port) : socket(igtl::ClientSocket::New()) {
    if (socket->ConnectToServer("127.0.0.1", port) != 0) fail("cannot connect");
    socket->SetReceiveTimeout(RECEIVE_LIMIT_MS);
  }

  void say(const char *device, const char *text) {
    igtl::StringMessage::Pointer message = igtl::StringMessage::New();
    message->SetDeviceName(device);
    message->SetString(text);
    message->Pack();
    if (!socket->Send(message->GetPackPointer(), message->GetPackSize())) fail("cannot send");
  }

  void until(const char *what, const std::function<bool()> &found) {
    const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(LIMIT_S);
    while (!found()) {
      if (std::chrono::steady_clock::now() > end) fail(std::string("no ") + what);
      receive();
    }
  }

  void print() const;

  bool closed = false;
  std::map<std::string, Pose> poses;
  std::map<std::string, std::string> strings;
  std::vector<std::string> answers;
  std::string image, points, surface, path, state_pair;

 private:
  [[noreturn]] static void fail(const std::string &why) {
    std::cerr << why << std::endl;
    std::exit(1);
  }

  void receive();
  template <typename Message>
  typename Message::Pointer body(igtl::MessageHeader::Pointer header);
  void see_image(igtl::ImageMessage::Pointer message);
  void see_points(igtl::PointMessage::Pointer message);
  void see_surface(igtl::PolyDataMessage::Pointer message);
  void see_path(igtl::PolyDataMessage::Pointer message);
  void see_text(const std::string &device, const std::string &text, const std::string &time);

  igtl::ClientSocket::Pointer socket;
  int good = 0;
  int bad = 0;
  std::set<std::string> other;
};

void Peer::receive() {
  igtl::MessageHeader::Pointer header = igtl::MessageHeader::New();
  header->InitPack();
  const int got = socket->Receive(header->GetPackPointer(), header->GetPackSize());
  if (got != header->GetPackSize()) {
    closed = got == 0;
    return;
  }
  if (!(header->Unpack() & igtl::MessageHeader::UNPACK_HEADER)) fail("a header that the library does not read");
  const std::string type = header->GetDeviceType(), device = header->GetDeviceName();
  unsigned int seconds = 0, fraction = 0;
  header->GetTimeStamp(&seconds, &fraction);
  const std::string time = std::to_string(seconds) + "." + std::to_string(fraction);
  if (type == "TRANSFORM") {
    if (auto message = body<igtl::TransformMessage>(header)) {
      igtl::Matrix4x4 matrix;
      message->GetMatrix(matrix);
      poses[device] = {numbers(matrix), time};
    }
  } else if (type == "IMAGE") {
    if (auto message = body<igtl::ImageMessage>(header)) see_image(message);
  } else if (type == "POINT") {
    if (auto message = body<igtl::PointMessage>(header)) see_points(message);
  } else if (type == "POLYDATA") {
    if (auto message = body<igtl::PolyDataMessage>(header)) see_surface(message);
  } else if (type == "STRING") {
    if (auto message = body<igtl::StringMessage>(header)) see_text(device, message->GetString(), time);
  } else if (type == "STATUS") {
    if (auto message = body<igtl::StatusMessage>(header))
      answers.push_back("[" + quoted(device) + "," + std::to_string(message->GetCode()) + "," + quoted(message->GetStatusString()) + "]");
  } else {
    other.insert(type);
    socket->Skip(header->GetBodySizeToRead(), 0);
  }
}

template <typename Message>
typename Message::Pointer Peer::body(igtl::MessageHeader::Pointer header) {
  typename Message::Pointer message = Message::New();
  message->SetMessageHeader(header);
  message->AllocatePack();
  if (socket->Receive(message->GetPackBodyPointer(), message->GetPackBodySize()) != message->GetPackBodySize()) {
    closed = true;
    return NULL;
  }
  // 1: with its CRC.
  if (!(message->Unpack(1) & igtl::MessageHeader::UNPACK_BODY)) {
    ++bad;
    return NULL;
  }
  ++good;
  return message;
}

void Peer::see_image(igtl::ImageMessage::Pointer message) {
  int size[3], part[3], offset[3];
  float spacing[3];
  igtl::Matrix4x4 matrix;
  message->GetDimensions(size);
  message->GetSubVolume(part, offset);
  message->GetSpacing(spacing);
  message->GetMatrix(matrix);
  if (message->GetScalarType() != igtl::ImageMessage::TYPE_UINT16 || message->GetNumComponents() != 1) fail("an image not of uint16");
  // FNV-1a over the bytes as sent.
  uint64_t hash = 0xcbf29ce484222325u;
  const unsigned char *bytes = static_cast<const unsigned char *>(message->GetScalarPointer());
  for (int i = 0; i < message->GetImageSize(); ++i) hash = (hash ^ bytes[i]) * 0x100000001b3u;
  std::ostringstream out;
  out << "{\"device\":" << quoted(message->GetDeviceName()) << ",\"size\":[" << size[0] << "," << size[1] << "," << size[2]
      << "],\"whole\":" << (part[0] == size[0] && part[1] == size[1] && part[2] == size[2] && !offset[0] && !offset[1] && !offset[2] ? "true" : "false")
      << ",\"endian\":" << message->GetEndian() << ",\"coordinates\":" << message->GetCoordinateSystem() << ",\"spacing_mm\":" << numbers(spacing, 3)
      << ",\"matrix\":" << numbers(matrix) << ",\"fnv1a\":\"" << hash << "\"}";
  image = out.str();
}

void Peer::see_points(igtl::PointMessage::Pointer message) {
  std::ostringstream out;
  for (int i = 0; i < message->GetNumberOfPointElement(); ++i) {
    igtl::PointElement::Pointer point;
    message->GetPointElement(i, point);
    float position[3];
    point->GetPosition(position);
    out << (i ? "," : "") << "[" << quoted(point->GetName()) << "," << quoted(point->GetGroupName()) << "," << numbers(position, 3) << "]";
  }
  points = "[" + out.str() + "]";
}

void Peer::see_surface(igtl::PolyDataMessage::Pointer message) {
  if (std::string(message->GetDeviceName()) == "PlannedPath") return see_path(message);
  const int count = message->GetPoints()->GetNumberOfPoints();
  float first[3] = {0, 0, 0};
  if (count > 0) message->GetPoints()->GetPoint(0, first);
  std::ostringstream out;
  igtl::PolyDataCellArray *cells = message->GetPolygons();
  bool valid = true;
  for (igtlUint32 i = 0; i < cells->GetNumberOfCells(); ++i) {
    std::list<igtlUint32> cell;
    cells->GetCell(i, cell);
    valid = valid && cell.size() == 4;
    for (igtlUint32 index : cell) valid = valid && static_cast<int>(index) < count;
  }
  out << "{\"points\":" << count << ",\"polygons\":" << cells->GetNumberOfCells() << ",\"valid\":" << (valid ? "true" : "false")
      << ",\"first_mm\":" << numbers(first, 3) << "}";
  surface = out.str();
}

void Peer::see_path(igtl::PolyDataMessage::Pointer message) {
  const int count = message->GetPoints()->GetNumberOfPoints();
  float first[3] = {0, 0, 0}, last[3] = {0, 0, 0};
  if (count > 0) {
    message->GetPoints()->GetPoint(0, first);
    message->GetPoints()->GetPoint(count - 1, last);
  }
  std::list<igtlUint32> line;
  if (message->GetLines()->GetNumberOfCells() == 1) message->GetLines()->GetCell(0, line);
  std::ostringstream out;
  out << "{\"points\":" << count << ",\"of_line\":" << line.size() << ",\"first_mm\":" << numbers(first, 3) << ",\"last_mm\":" << numbers(last, 3) << "}";
  path = out.str();
}

void Peer::see_text(const std::string &device, const std::string &text, const std::string &time) {
  strings[device] = text;
  // A line of figures and a pose with the same time belong to the same state.
  const auto burr = poses.find("BurrToRAS");
  if (device == "State" && burr != poses.end() && burr->second.time == time)
    state_pair = "{\"state\":" + quoted(text) + ",\"burr\":" + burr->second.matrix + "}";
}

void Peer::print() const {
  std::cout << "{\"good\":" << good << ",\"bad\":" << bad << ",\"other\":" << other.size() << ",\"poses\":[";
  const char *comma = "";
  for (const auto &pose : poses) {
    std::cout << comma << quoted(pose.first);
    comma = ",";
  }
  std::cout << "],\"answers\":[";
  comma = "";
  for (const auto &answer : answers) {
    std::cout << comma << answer;
    comma = ",";
  }
  std::cout << "],\"image\":" << image << ",\"points\":" << points << ",\"surface\":" << surface << ",\"path\":" << path << ",\"pair\":" << state_pair << "}" << std::endl;
}

bool holds(const std::string &text, const std::string &part) { return text.find(part) != std::string::npos; }

}  // namespace

int main(int argc, char **argv) {
  if (argc != 3) return 2;
  Peer peer(std::atoi(argv[1]));
  const auto heard = [&](const std::string &what) {
    for (const std::string &answer : peer.answers)
      if (holds(answer, what)) return true;
    return false;
  };
  const auto phase = [&](const char *wanted) { return holds(peer.strings["State"], std::string("phase=") + wanted + " "); };

  peer.until("message of every kind", [&] {
    return peer.poses.size() > 4 && !peer.image.empty() && !peer.points.empty() && !peer.surface.empty() && !peer.path.empty() && !peer.state_pair.empty();
  });
  peer.say("Command", "pause");
  peer.until("refusal without the token", [&] { return heard("send the control token first"); });
  peer.say("Token", argv[2]);
  peer.until("permission", [&] { return heard("control granted to this connection"); });
  peer.say("Command", "jump");
  peer.until("refusal of an unknown command", [&] { return heard("unknown command jump; expected pause, resume, stop or halt"); });
  peer.say("Command", "pause");
  peer.until("pause", [&] { return phase("paused"); });
  peer.say("Command", "resume");
  peer.until("going on", [&] { return phase("running"); });
  peer.say("Command", "stop");
  peer.until("end", [&] { return peer.closed || phase("ended"); });
  peer.print();
  return 0;
}
