"use strict";
// Tabs, theme, copy buttons and the two 3-D views. The page is complete without any of this.

const scenes = JSON.parse(document.getElementById("scenes").textContent);

// ---- tabs: one stop in the tab order, arrows move between them (WAI-ARIA authoring practices)
const tabs = [...document.querySelectorAll("[role=tab]")];

function select(tab, focus) {
  for (const other of tabs) {
    const chosen = other === tab;
    other.setAttribute("aria-selected", chosen);
    other.tabIndex = chosen ? 0 : -1;
    document.getElementById(other.getAttribute("aria-controls")).classList.toggle("away", !chosen);
  }
  if (focus) tab.focus();
  tab.scrollIntoView({ block: "nearest", inline: "nearest" });
  views.forEach((view) => view.draw());
}

tabs.forEach((tab, index) => {
  tab.addEventListener("click", () => {
    select(tab);
    history.replaceState(null, "", "#" + tab.getAttribute("aria-controls"));
  });
  tab.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    const ends = { Home: 0, End: tabs.length - 1 };
    const next = event.key in ends ? ends[event.key] : (index + (step || 0) + tabs.length) % tabs.length;
    if (step || event.key in ends) {
      event.preventDefault();
      select(tabs[next], true);
    }
  });
});

// ---- theme: the system's, until the button says otherwise
const root = document.documentElement;
const themeButton = document.getElementById("theme");
const isDark = () =>
  root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;

themeButton.addEventListener("click", () => {
  root.dataset.theme = isDark() ? "light" : "dark";
  views.forEach((view) => view.draw());
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => views.forEach((view) => view.draw()));

// ---- copy buttons
const announce = document.getElementById("announce");

async function copyText(text) {
  if (navigator.clipboard && window.isSecureContext) {
    await navigator.clipboard.writeText(text);
    return;
  }
  const area = document.createElement("textarea"); // pages opened from disk have no clipboard of their own
  area.value = text;
  area.className = "offscreen";
  document.body.append(area);
  area.select();
  const done = document.execCommand("copy");
  area.remove();
  if (!done) throw new Error("copying was refused");
}

document.querySelectorAll("button[data-copy]").forEach((button) =>
  button.addEventListener("click", async () => {
    const label = button.textContent;
    try {
      await copyText(button.dataset.copy);
      button.textContent = "copied";
      announce.textContent = label + " copied";
    } catch (error) {
      button.textContent = "not copied";
      announce.textContent = "The browser refused to copy: " + error.message;
    }
    setTimeout(() => (button.textContent = label), 1500);
  })
);

document.querySelectorAll("input[data-hides]").forEach((box) =>
  box.addEventListener("change", () =>
    document.getElementById(box.dataset.hides).classList.toggle("bare", !box.checked)
  )
);

// ---- 3-D: a small renderer on a 2-D canvas; segments and faces sorted by depth
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const times = (a, s) => [a[0] * s, a[1] * s, a[2] * s];

function colourOf(index) {
  return getComputedStyle(root).getPropertyValue(index < 0 ? "--text" : "--c" + (index % 8)).trim();
}

class View {
  constructor(canvas, content, scene) {
    this.canvas = canvas;
    this.content = content; // () -> list of {line|face|dot|text, colour, ...}
    this.scene = scene; // middle and radius of what is shown
    this.home = { azimuth: -2.2, elevation: 0.55, zoom: 1 };
    Object.assign(this, this.home);
    this.from = this.home;
    this.pointers = new Map();
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const end of ["pointerup", "pointercancel"])
      canvas.addEventListener(end, (event) => this.pointers.delete(event.pointerId));
    canvas.addEventListener(
      "wheel",
      (event) => {
        if (!event.ctrlKey && document.activeElement !== canvas) return; // the page scrolls unless asked
        event.preventDefault();
        this.turn(0, 0, Math.exp(-event.deltaY / 600));
      },
      { passive: false }
    );
    canvas.addEventListener("keydown", (event) => {
      const move = {
        ArrowLeft: [-0.1, 0, 1], ArrowRight: [0.1, 0, 1], ArrowUp: [0, 0.1, 1], ArrowDown: [0, -0.1, 1],
        "+": [0, 0, 1.15], "-": [0, 0, 1 / 1.15],
      }[event.key];
      if (!move) return;
      event.preventDefault();
      this.turn(...move);
    });
    canvas.parentElement.querySelectorAll("button[data-view]").forEach((button) =>
      button.addEventListener("click", () => this.look(button.dataset.view))
    );
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  look(name) {
    const [azimuth, elevation] = {
      top: [-Math.PI / 2, Math.PI / 2 - 1e-3], side: [-Math.PI / 2, 0], ahead: [0, 0],
      home: [this.home.azimuth, this.home.elevation],
    }[name];
    this.from = { azimuth, elevation };
    Object.assign(this, { azimuth, elevation, zoom: 1 });
    this.draw();
  }

  turn(azimuth, elevation, zoom) {
    this.azimuth -= azimuth;
    this.elevation = Math.max(-1.57, Math.min(1.57, this.elevation + elevation));
    this.zoom = Math.max(0.2, Math.min(20, this.zoom * zoom));
    this.draw();
  }

  drag(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    if (this.pointers.size === 1) this.turn((now[0] - before[0]) / 150, (now[1] - before[1]) / 150, 1);
    else {
      const other = [...this.pointers].find(([id]) => id !== event.pointerId)[1];
      const span = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]) || 1;
      this.turn(0, 0, span(now) / span(before));
    }
    this.pointers.set(event.pointerId, now);
  }

  draw() {
    const { canvas } = this;
    const width = canvas.clientWidth, height = canvas.clientHeight, ratio = devicePixelRatio || 1;
    if (!width || !height) return;
    canvas.width = width * ratio;
    canvas.height = height * ratio;
    const pen = canvas.getContext("2d");
    pen.scale(ratio, ratio);
    const [ca, sa, ce, se] = [this.azimuth, this.elevation].flatMap((x) => [Math.cos(x), Math.sin(x)]);
    const towards = [ce * ca, ce * sa, se], right = [-sa, ca, 0], up = [-se * ca, -se * sa, ce];
    const { middle, radius } = this.scene;
    const parts = this.content();
    const distance = 6 * radius, scale = this.fit(parts, width, height, distance) * this.zoom;
    const place = (point) => {
      const p = add(point, times(middle, -1));
      const shrink = distance / (distance - dot(p, towards));
      return [width / 2 + dot(p, right) * scale * shrink, height / 2 - dot(p, up) * scale * shrink];
    };
    const depth = (part) => {
      const points = part.line || part.face || [part.dot || part.text];
      return points.reduce((sum, p) => sum + dot(p, towards), 0) / points.length;
    };
    for (const part of parts)
      part.depth = part.text ? 1e9 : part.behind ? -1e9 : depth(part) + (part.face ? -1e-6 : 0);
    parts.sort((a, b) => a.depth - b.depth);
    for (const part of parts) this.paint(pen, part, place);
    canvas.dataset.drawn = parts.length;
  }

  // pixels per metre at which everything fits from where the view was last sent: turning does not change it
  fit(parts, width, height, distance) {
    const { azimuth, elevation } = this.from;
    const [ca, sa, ce, se] = [azimuth, elevation].flatMap((x) => [Math.cos(x), Math.sin(x)]);
    const towards = [ce * ca, ce * sa, se], right = [-sa, ca, 0], up = [-se * ca, -se * sa, ce];
    let across = 1e-6, along = 1e-6;
    for (const part of parts)
      for (const point of part.uncertainty ? [] : part.cloud || part.line || part.face || [part.dot || part.text]) {
        const p = add(point, times(this.scene.middle, -1));
        const shrink = distance / (distance - dot(p, towards));
        across = Math.max(across, Math.abs(dot(p, right)) * shrink);
        along = Math.max(along, Math.abs(dot(p, up)) * shrink);
      }
    return Math.min((0.46 * width) / across, (0.46 * height) / along);
  }

  paint(pen, part, place) {
    pen.globalAlpha = part.alpha || 1;
    pen.strokeStyle = pen.fillStyle = part.colour;
    pen.lineWidth = part.width || 1.5;
    pen.setLineDash(part.dashed ? [5, 4] : []);
    pen.beginPath();
    if (part.cloud) {
      for (const point of part.cloud) {
        const [u, v] = place(point);
        pen.fillRect(u - 0.9, v - 0.9, 1.8, 1.8);
      }
    } else if (part.dot) {
      pen.arc(...place(part.dot), part.radius || 3, 0, 7);
      pen.fill();
    } else if (part.text) {
      const [u, v] = place(part.text);
      pen.font = (part.bold ? "600 " : "") + (part.small ? "11px" : "13px") + " system-ui, sans-serif";
      pen.lineWidth = 4;
      pen.strokeStyle = colourOfBackground();
      pen.lineJoin = "round";
      pen.globalAlpha = 1;
      pen.strokeText(part.words, u + 8, v - 6);
      pen.fillText(part.words, u + 8, v - 6);
    } else {
      (part.line || part.face).forEach((p, i) => pen[i ? "lineTo" : "moveTo"](...place(p)));
      if (part.face) {
        pen.closePath();
        pen.fill();
      } else pen.stroke();
    }
  }
}

const colourOfBackground = () => getComputedStyle(root).getPropertyValue("--card").trim();

function axes(length, names, faint) {
  return names.flatMap((name, i) => {
    const end = [0, 0, 0];
    end[i] = length;
    return [
      { line: [[0, 0, 0], end], colour: faint, width: 1.5 },
      { text: end, words: name, colour: faint },
    ];
  });
}

// a level grid with the metres of its lines, of every second where there is little room; drawn below everything
function gridParts(grid, faint) {
  if (!grid) return [];
  const [west, south] = grid.low, [east, north] = grid.high, z = grid.z, parts = [];
  const line = (a, b) => parts.push({ line: [a, b], colour: faint, width: 0.7, alpha: 0.45, behind: true });
  const name = (at, words) => parts.push({ text: at, words, colour: faint, small: true });
  const every = innerWidth < 600 ? 2 : 1;
  grid.x.forEach((x, k) => {
    line([x, south, z], [x, north, z]);
    if (k % every === 0) name([x, south, z], grid.x_names[k]);
  });
  grid.y.forEach((y, k) => {
    line([west, y, z], [east, y, z]);
    if (k && k % every === 0) name([west, y, z], grid.y_names[k]);
  });
  return parts;
}

function ellipsoid(centre, sigmaAxes, factor, colour) {
  const parts = [];
  for (const [i, j] of [[0, 1], [1, 2], [2, 0]]) {
    const ring = [];
    for (let k = 0; k <= 32; k++) {
      const t = (k / 32) * 2 * Math.PI;
      ring.push(
        add(centre, add(times(sigmaAxes[i], factor * Math.cos(t)), times(sigmaAxes[j], factor * Math.sin(t))))
      );
    }
    parts.push({ face: ring, colour, alpha: 0.12, uncertainty: true });
    parts.push({ line: ring, colour, alpha: 0.8, width: 1, uncertainty: true });
  }
  return parts;
}

function rigParts() {
  const rig = scenes.rig, text = colourOf(-1);
  const faint = getComputedStyle(root).getPropertyValue("--faint").trim();
  const factor = Number(document.getElementById("sigma").value);
  const parts = [...gridParts(rig.grid, faint), ...axes(rig.extent * 0.35, ["x", "y", "z"], faint)];
  if (rig.hull) {
    parts.push({ face: rig.hull, colour: faint, alpha: 0.13 });
    parts.push({ line: [...rig.hull, rig.hull[0]], colour: faint, alpha: 0.9 });
  }
  rig.cameras.forEach((camera, index) => {
    const colour = colourOf(index), open = camera.position.includes(null) || !camera.frustum;
    const at = camera.position.map((x) => x ?? 0);
    parts.push({ dot: at, colour, radius: 3.5 });
    const words = open ? camera.name + " (unobservable)" : camera.name;
    parts.push({ text: at, words, colour: text, bold: true });
    for (const direction of camera.open) {
      const reach = times(direction, rig.extent * 0.45);
      parts.push({ line: [add(at, times(reach, -1)), add(at, reach)], colour, dashed: true, width: 2 });
    }
    if (camera.frustum) {
      const corners = camera.frustum.map((corner) => add(at, corner));
      corners.forEach((corner, k) => {
        const next = corners[(k + 1) % 4];
        parts.push({ face: [at, corner, next], colour, alpha: open ? 0.06 : 0.16 });
        parts.push({ line: [at, corner], colour, dashed: open }, { line: [corner, next], colour, dashed: open });
      });
      const top = times(add(camera.frustum[0], camera.frustum[1]), 0.5); // a tab marks the upper edge
      const middle = times(camera.frustum.reduce(add), 0.25);
      const tip = add(at, add(top, times(add(top, times(middle, -1)), 0.35)));
      parts.push({ line: [corners[0], tip, corners[1]], colour, dashed: open });
    }
    if (camera.sigma_axes) parts.push(...ellipsoid(at, camera.sigma_axes, factor, colour));
  });
  if (rig.antenna) {
    parts.push({ dot: rig.antenna, colour: text, radius: 3 });
    parts.push({ text: rig.antenna, words: "antenna", colour: text });
  }
  return parts;
}

function pathParts() {
  const faint = getComputedStyle(root).getPropertyValue("--faint").trim();
  const parts = [
    ...gridParts(scenes.paths.grid, faint),
    ...axes(scenes.paths.extent * 0.25, ["east", "north", "up"], faint),
  ];
  const box = document.getElementById("landmarks");
  if (!box || box.checked)
    for (const cloud of scenes.paths.cloud)
      parts.push({ cloud: cloud.points, colour: colourOf(cloud.colour), alpha: 0.7, behind: true });
  for (const path of scenes.paths.paths) {
    const colour = colourOf(path.colour);
    for (let k = 0; k + 1 < path.points.length; k += 8)
      parts.push({ line: path.points.slice(k, k + 9), colour, width: path.colour < 0 ? 2.5 : 1.2 });
    parts.push({ dot: path.points[0], colour, radius: 4 });
    if (path.colour < 0) parts.push({ text: path.points[0], words: "start", colour });
  }
  return parts;
}

const views = [];
const rigCanvas = document.getElementById("rig3d");
if (rigCanvas) {
  const view = new View(rigCanvas, rigParts, scenes.rig);
  views.push(view);
  const range = document.getElementById("sigma");
  range.addEventListener("input", () => {
    document.getElementById("sigma-value").textContent = range.value;
    view.draw();
  });
}
const pathCanvas = document.getElementById("path3d");
if (pathCanvas) {
  const view = new View(pathCanvas, pathParts, scenes.paths);
  views.push(view);
  const box = document.getElementById("landmarks");
  if (box) box.addEventListener("change", () => view.draw());
}

// ---- paper: light, and with every view drawn, also those whose panel is hidden
let themeOnScreen;
addEventListener("beforeprint", () => {
  themeOnScreen = root.dataset.theme;
  root.dataset.theme = "light";
  document.querySelectorAll("section").forEach((section) => section.classList.remove("away"));
  views.forEach((view) => view.draw());
});
addEventListener("afterprint", () => {
  if (themeOnScreen) root.dataset.theme = themeOnScreen;
  else delete root.dataset.theme;
  select(tabs.find((tab) => tab.getAttribute("aria-selected") === "true"));
});

root.classList.add("scripted");
select(tabs.find((tab) => "#" + tab.getAttribute("aria-controls") === location.hash) || tabs[0]);
root.dataset.ready = "yes";
