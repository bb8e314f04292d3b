"use strict";
/* Maps that zoom and pan, with grid, scale bar and coordinates; and the raw/clean slider. */
(() => {
const MAX_CELL = 40; /* screen pixels per map cell at the largest zoom */
const GRID_SPACING = 90; /* smallest distance of grid lines in screen pixels */
const STEP = 1.5, PAN = 60; /* factor of a zoom step, pixels of an arrow key */
const STATES = {0: "occupied", 254: "free", 205: "unknown"};

/* The largest of 1, 2 and 5 times a power of ten that is at most the value. */
const roundDown = (value) => {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * [5, 2, 1].find((n) => n * power <= value * 1.000001);
};
const label = (metres) => String(Number(metres.toPrecision(6)));
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

class MapView {
  constructor(stage) {
    this.stage = stage;
    this.port = stage.querySelector(".viewport");
    this.sheets = stage.querySelectorAll(".sheet");
    this.written = stage.querySelector(".written");
    const numbers = (name) => stage.dataset[name].split(" ").map(Number);
    [this.x0, this.y0, this.x1, this.y1] = numbers("window");
    this.bounds = numbers("bounds");
    this.cell = Number(stage.dataset.cell);
    this.pixel = document.createElement("canvas").getContext("2d", {willReadFrequently: true});
    this.pointers = new Map();
    this.bar = this.port.querySelector(".scale");
    this.lines = this.port.querySelector(".grid svg");
    this.still = {bar: this.bar.textContent, lines: this.lines.innerHTML,
      box: this.lines.getAttribute("viewBox")};
    stage.classList.add("live");
    for (const hidden of stage.querySelectorAll("[hidden]")) hidden.hidden = false;
    this.port.tabIndex = 0;
    this.port.setAttribute("aria-label", `${this.port.getAttribute("aria-label")}: `
      + "arrow keys move it, plus and minus zoom, 0 shows all");
    this.showAll();
    this.listen();
    window.addEventListener("beforeprint", () => this.freeze());
    window.addEventListener("afterprint", () => this.resume());
    new ResizeObserver(() => this.draw()).observe(this.port);
  }

  /* Size of the viewport, and place and size of the window in it before zooming. */
  get layout() {
    const width = this.port.clientWidth, height = this.port.clientHeight;
    const ratio = (this.x1 - this.x0) / (this.y1 - this.y0);
    const w = Math.min(width, height * ratio), h = w / ratio;
    return {width, height, w, h, left: (width - w) / 2, top: (height - h) / 2};
  }

  /* Zoom k, and the map point (x, y) in metres at the middle of the viewport. */
  showAll() {
    this.k = 1;
    this.x = (this.x0 + this.x1) / 2;
    this.y = (this.y0 + this.y1) / 2;
    this.draw();
  }

  metresPerPixel(layout = this.layout) {
    return (this.x1 - this.x0) / (layout.w * this.k);
  }

  toMap(px, py) {
    const layout = this.layout, m = this.metresPerPixel(layout);
    return [this.x + (px - layout.width / 2) * m, this.y - (py - layout.height / 2) * m];
  }

  zoom(factor, px = this.port.clientWidth / 2, py = this.port.clientHeight / 2) {
    const layout = this.layout, [x, y] = this.toMap(px, py);
    const [left, bottom, right, top] = this.bounds;
    const whole = Math.min((this.x1 - this.x0) / (right - left),
      (this.y1 - this.y0) / (top - bottom), 1);
    const most = Math.max(1, MAX_CELL * (this.x1 - this.x0) / (this.cell * layout.w));
    this.k = clamp(this.k * factor, 0.8 * whole, most);
    const m = this.metresPerPixel(layout);
    this.moveTo(x - (px - layout.width / 2) * m, y + (py - layout.height / 2) * m);
  }

  pan(dx, dy) {
    const m = this.metresPerPixel();
    this.moveTo(this.x - dx * m, this.y + dy * m);
  }

  moveTo(x, y) {
    const [left, bottom, right, top] = this.bounds;
    this.x = clamp(x, left, right);
    this.y = clamp(y, bottom, top);
    this.draw();
  }

  /* Paper has another width, which no script hears of: the whole map, in shares of it. */
  freeze() {
    this.stage.classList.remove("live", "zoomed");
    for (const sheet of this.sheets) sheet.style.transform = "";
    this.bar.style.width = "";
    this.bar.textContent = this.still.bar;
    this.lines.setAttribute("viewBox", this.still.box);
    this.lines.innerHTML = this.still.lines;
  }

  resume() {
    this.stage.classList.add("live");
    this.draw();
  }

  draw() {
    if (!this.stage.classList.contains("live")) return;
    const layout = this.layout, m = this.metresPerPixel(layout);
    if (!layout.w) return;
    const dx = layout.width / 2 - layout.left - (this.x - this.x0) / m;
    const dy = layout.height / 2 - layout.top - (this.y1 - this.y) / m;
    for (const sheet of this.sheets) {
      sheet.style.transform = `translate(${dx}px, ${dy}px) scale(${this.k})`;
    }
    this.stage.classList.toggle("zoomed", this.k > 1.01);
    const length = roundDown(m * Math.min(180, layout.width / 4));
    this.bar.style.width = `${length / m}px`;
    this.bar.textContent = length < 1 ? `${label(100 * length)} cm` : `${label(length)} m`;
    this.drawGrid(layout, m);
  }

  drawGrid({width, height}, m) {
    const step = roundDown(2.5 * GRID_SPACING * m);
    const [left, top] = this.toMap(0, 0), [right, bottom] = this.toMap(width, height);
    let lines = "", axes = "", texts = "";
    for (let n = Math.ceil(left / step); n * step <= right; n++) {
      const px = ((n * step - left) / m).toFixed(1), line = `M${px} 0V${height}`;
      if (n) lines += line; else axes += line;
      if (px > 40) texts += `<text x="${px}" y="${height - 7}" text-anchor="middle">${label(n * step)}</text>`;
    }
    for (let n = Math.ceil(bottom / step); n * step <= top; n++) {
      const py = ((top - n * step) / m).toFixed(1), line = `M0 ${py}H${width}`;
      if (n) lines += line; else axes += line;
      if (py < height - 24) texts += `<text x="6" y="${Number(py) + 4}">${label(n * step)}</text>`;
    }
    this.lines.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.lines.innerHTML = `<path d="${lines}"/><path class="axis" d="${axes}"/>${texts}`;
  }

  /* Coordinates at a point of the viewport, and the state of the cell there. */
  read(px, py) {
    const [x, y] = this.toMap(px, py);
    const digits = this.metresPerPixel() < 0.02 ? 3 : 2;
    const state = this.written ? this.stateAt(px, py) : "";
    this.say(`x ${x.toFixed(digits)} m, y ${y.toFixed(digits)} m${state && ": " + state}`);
  }

  say(text) {
    this.stage.querySelector(".readout").textContent = text;
  }

  stateAt(px, py) {
    const image = this.written, box = image.getBoundingClientRect();
    const port = this.port.getBoundingClientRect();
    const left = port.left + this.port.clientLeft, top = port.top + this.port.clientTop;
    const column = Math.floor((px + left - box.left) / box.width * image.naturalWidth);
    const row = Math.floor((py + top - box.top) / box.height * image.naturalHeight);
    const inside = column >= 0 && row >= 0 && column < image.naturalWidth
      && row < image.naturalHeight;
    if (!inside) return "outside the map";
    this.pixel.drawImage(image, column, row, 1, 1, 0, 0, 1, 1);
    return STATES[this.pixel.getImageData(0, 0, 1, 1).data[0]] || "";
  }

  listen() {
    const at = (event) => {
      const box = this.port.getBoundingClientRect();
      return [event.clientX - box.left - this.port.clientLeft,
        event.clientY - box.top - this.port.clientTop];
    };
    const port = this.port;
    port.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      this.pointers.set(event.pointerId, at(event));
      port.setPointerCapture(event.pointerId);
    });
    port.addEventListener("pointermove", (event) => {
      this.read(...at(event));
      if (this.pointers.has(event.pointerId)) this.drag(event.pointerId, at(event));
    });
    for (const name of ["pointerup", "pointercancel"]) {
      port.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    port.addEventListener("pointerleave", () => this.say(""));
    port.addEventListener("dragstart", (event) => event.preventDefault());
    port.addEventListener("dblclick", (event) => this.zoom(STEP * STEP, ...at(event)));
    port.addEventListener("wheel", (event) => {
      /* the page scrolls unless the map was clicked or a key says zoom, as a pinch does */
      const meant = event.ctrlKey || event.metaKey || document.activeElement === port
        || document.fullscreenElement === this.stage;
      if (!meant) {
        this.say("Ctrl and wheel zoom; so does the wheel after a click");
        return;
      }
      event.preventDefault();
      const pixels = event.deltaY * (event.deltaMode ? 30 : 1);
      this.zoom(Math.exp(-clamp(pixels, -200, 200) / (event.ctrlKey ? 120 : 300)), ...at(event));
    }, {passive: false});
    port.addEventListener("keydown", (event) => this.press(event));
    for (const button of this.stage.querySelectorAll("[data-do]")) {
      button.addEventListener("click", () => this.act(button.dataset.do));
    }
  }

  /* One pointer pans, two zoom as well. */
  drag(id, now) {
    const before = this.pointers.get(id);
    const others = [...this.pointers].filter(([other]) => other !== id);
    if (others.length === 0) {
      this.pan(now[0] - before[0], now[1] - before[1]);
    } else {
      const fixed = others[0][1];
      const distance = (point) => Math.hypot(point[0] - fixed[0], point[1] - fixed[1]);
      this.zoom(distance(now) / Math.max(distance(before), 1), ...fixed);
    }
    this.pointers.set(id, now);
  }

  press(event) {
    const moves = {ArrowLeft: [PAN, 0], ArrowRight: [-PAN, 0], ArrowUp: [0, PAN],
      ArrowDown: [0, -PAN]};
    const acts = {"+": "in", "=": "in", "-": "out", "0": "all"};
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key in moves) this.pan(...moves[event.key]);
    else if (event.key in acts) this.act(acts[event.key]);
    else return;
    event.preventDefault();
    this.read(this.port.clientWidth / 2, this.port.clientHeight / 2);
  }

  act(what) {
    if (what === "in") this.zoom(STEP);
    else if (what === "out") this.zoom(1 / STEP);
    else if (what === "full" && document.fullscreenElement) document.exitFullscreen();
    else if (what === "full") this.stage.requestFullscreen();
    else this.showAll();
  }
}

/* Both maps one over the other; the raw one is cut off at the divider. */
const slide = (section) => {
  const slider = section.querySelector(".slider"), range = slider.querySelector("input");
  for (const sheet of slider.querySelectorAll("[data-copy]")) {
    const image = section.querySelector(`#${sheet.dataset.copy}`).cloneNode();
    image.removeAttribute("id");
    sheet.append(image);
  }
  slider.hidden = false;
  section.classList.add("sliding");
  const show = () => slider.style.setProperty("--split", `${range.value}%`);
  range.addEventListener("input", show);
  show();
  const divider = slider.querySelector(".divider");
  divider.addEventListener("pointerdown", (event) => {
    event.stopPropagation();
    divider.setPointerCapture(event.pointerId);
  });
  divider.addEventListener("pointermove", (event) => {
    if (!divider.hasPointerCapture(event.pointerId)) return;
    event.stopPropagation();
    const box = divider.parentElement.getBoundingClientRect();
    range.value = 100 * (event.clientX - box.left) / box.width;
    show();
  });
};

for (const section of document.querySelectorAll(".compare")) slide(section);
for (const stage of document.querySelectorAll(".stage")) new MapView(stage);
})();
