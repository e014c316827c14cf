// The socket to the server; when it breaks, tries again until it is back.

const AGAIN_MS = 1000;

/** Opens the stream. `on` has `text(message)`, `update(buffer)`, `state(connected)`. */
export function openStream(on) {
  const stream = { socket: null, bytes: 0, updates: 0 };
  const connect = () => {
    const socket = new WebSocket(`ws://${location.host}/stream`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => on.state(true);
    socket.onmessage = ({ data }) => {
      if (typeof data === "string") {
        on.text(JSON.parse(data));
      } else {
        stream.bytes += data.byteLength;
        stream.updates += 1;
        on.update(data);
      }
    };
    socket.onclose = () => {
      on.state(false);
      setTimeout(connect, AGAIN_MS);
    };
    stream.socket = socket;
  };
  stream.ask = (wanted) => {
    if (stream.socket?.readyState === WebSocket.OPEN) stream.socket.send(JSON.stringify(wanted));
  };
  connect();
  return stream;
}
