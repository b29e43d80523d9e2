// Asks for the newest picture, shows it, asks again. A slow page so shows fewer pictures, never older ones.
"use strict";
(() => {
  const state = { view: "panorama", camera: "", shown: 0, socket: null, retry_ms: 250, mesh: false };
  const limit = Number(new URLSearchParams(location.search).get("fps")) || 0;
  const by = (id) => document.getElementById(id);
  const flat = by("flat"), pen = flat.getContext("2d"), bowl = new Bowl(by("bowl"));
  const buttons = { panorama: by("panorama"), topdown: by("topdown"), camera: by("camera"), bowl: by("bowl-button") };
  const report = document.body.dataset;
  report.state = "connecting"; report.frames = "0"; report.connections = "0";

  function choose(view) {
    state.view = view;
    for (const [name, button] of Object.entries(buttons)) button.setAttribute("aria-pressed", name === view);
    by("bowl").hidden = view !== "bowl"; flat.hidden = view === "bowl";
    report.view = view; report.shown = "";
    by("words").textContent = "";
  }
  for (const name of Object.keys(buttons)) buttons[name].addEventListener("click", () => choose(name));
  by("cameras").addEventListener("change", (event) => { state.camera = event.target.value; choose("camera"); });
  choose("panorama");

  function ask(again) {
    const socket = state.socket;
    if (!socket || socket.readyState !== WebSocket.OPEN) return;
    const view = state.view === "bowl" && !state.mesh ? "mesh" : state.view;
    socket.send(JSON.stringify({ view, camera: state.camera, again: Boolean(again) }));
  }

  function next() {
    if (limit > 0) setTimeout(ask, 1000 / limit); else requestAnimationFrame(() => ask());
  }

  async function receive(data) {
    if (typeof data === "string") return words(JSON.parse(data));
    const length = new DataView(data).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
    if (header.kind === "mesh") {
      bowl.setMesh(header, data.slice(4 + length));
      state.mesh = true;
      return ask(true);
    }
    let at = 4 + length;
    const pictures = [];
    for (const size of header.lengths) {
      pictures.push(size ? await createImageBitmap(new Blob([data.slice(at, at + size)], { type: "image/jpeg" })) : null);
      at += size;
    }
    if (header.kind !== state.view) return next();  // chosen otherwise in the meantime
    if (header.kind === "bowl") bowl.setPictures(header, pictures); else draw(pictures[0]);
    for (const picture of pictures) if (picture) picture.close();
    shown(header);
    next();
  }

  function draw(picture) {
    if (!picture) { pen.fillStyle = "#333"; pen.fillRect(0, 0, flat.width, flat.height); return; }
    if (flat.width !== picture.width || flat.height !== picture.height) {
      flat.width = picture.width; flat.height = picture.height;
    }
    pen.drawImage(picture, 0, 0);
  }

  const times = [];
  function shown(header) {
    const now = Date.now() / 1000, age = now - header.taken_s;
    times.push(now); while (times.length && times[0] < now - 2) times.shift();
    report.frames = String(++state.shown); report.age = age.toFixed(3); report.shown = header.kind;
    report.number = String(header.number);
    by("status").textContent = `${(times.length / 2).toFixed(0)} pictures/s, ${(1000 * age).toFixed(0)} ms old`;
    const missing = Object.entries(header.missing).map(([name, why]) => `${name}: ${why}`);
    if (header.levelled === "none") missing.push("not levelled");
    by("words").textContent = missing.join("   ");
  }

  function words(message) {
    if (message.kind === "hello") {
      const list = by("cameras"), kept = state.camera;
      list.replaceChildren(...message.cameras.map((name) => Object.assign(document.createElement("option"),
        { value: name, textContent: name })));
      state.camera = message.cameras.includes(kept) ? kept : message.cameras[0];
      list.value = state.camera;
      return ask(true);
    }
    by("words").textContent = message.words;
    if (message.kind === "refused") { report.shown = "refused"; setTimeout(() => ask(true), 500); } else ask();
  }

  function connect() {
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live`);
    socket.binaryType = "arraybuffer";
    state.socket = socket; state.mesh = false;
    socket.onopen = () => {
      state.retry_ms = 250; report.state = "open"; report.connections = String(Number(report.connections) + 1);
    };
    let queue = Promise.resolve();
    socket.onmessage = (event) => {
      queue = queue.then(() => receive(event.data)).catch((error) => { by("words").textContent = String(error); next(); });
    };
    socket.onclose = () => {
      report.state = "lost"; by("status").textContent = "connection lost: trying again";
      setTimeout(connect, state.retry_ms); state.retry_ms = Math.min(2 * state.retry_ms, 2000);
    };
  }
  window.surround = { state, bowl, choose };
  connect();
})();
