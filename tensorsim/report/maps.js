"use strict";

function bytesOf(base64) {
  return Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
}

// A number with so many digits; what rounds to zero has no sign.
function fixed(value, digits) {
  return (Number(value.toFixed(digits)) || 0).toFixed(digits);
}

// Round numbers, at most about `most` of them, between two ends.
function ticksBetween(low, high, most) {
  const rough = (high - low) / most;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((size) => size >= rough);
  const ticks = [];
  for (let tick = Math.ceil(low / step) * step; tick <= high + 1e-9; tick += step) ticks.push(tick);
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  return ticks.map((tick) => [tick, fixed(tick, digits)]);
}

function sizedContext(canvas) {
  const scale = window.devicePixelRatio || 1;
  const width = Math.round(canvas.clientWidth * scale), height = Math.round(canvas.clientHeight * scale);
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
  const context = canvas.getContext("2d");
  context.setTransform(scale, 0, 0, scale, 0, 0);
  return context;
}

const MARGIN = { left: 62, right: 50, top: 6, bottom: 22 };

// One map with its axes and the cursor.
class MapView {
  constructor(holder, map, duration, seek) {
    this.map = map;
    this.duration = duration;
    const heading = holder.appendChild(document.createElement("h2"));
    heading.textContent = `${map.title} (dB below ${map.reference})`;
    this.canvas = holder.appendChild(document.createElement("canvas"));
    this.canvas.dataset.map = map.name;
    const at = (event) => {
      const box = this.canvas.getBoundingClientRect();
      const share = (event.clientX - box.left - MARGIN.left) / (box.width - MARGIN.left - MARGIN.right);
      seek(Math.min(Math.max(share, 0), 1) * duration);
    };
    this.canvas.addEventListener("pointerdown", at);
    this.canvas.addEventListener("pointermove", (event) => event.buttons && at(event));
  }

  async load() {
    const image = new Image();
    image.src = `data:image/png;base64,${this.map.png}`;
    await image.decode();
    this.picture = document.createElement("canvas");
    [this.picture.width, this.picture.height] = [image.width, image.height];
    const context = this.picture.getContext("2d", { willReadFrequently: true });
    context.drawImage(image, 0, 0);
    const pixels = context.getImageData(0, 0, image.width, image.height).data;
    this.levels = Uint8Array.from({ length: pixels.length / 4 }, (_, index) => pixels[4 * index]);
  }

  // `table` has 256 RGB colours; what is more than `range` dB below the peak has the first one.
  colour(table, range) {
    const context = this.picture.getContext("2d");
    const image = context.createImageData(this.picture.width, this.picture.height);
    for (let index = 0; index < this.levels.length; index++) {
      const below = (1 - this.levels[index] / 255) * this.map.stored_db;
      const entry = 3 * Math.round(255 * Math.max(0, 1 - below / range));
      image.data.set([table[entry], table[entry + 1], table[entry + 2], 255], 4 * index);
    }
    context.putImageData(image, 0, 0);
  }

  // `ridgeColours` has one per ridge; null hides them.
  draw(time, ridgeColours) {
    const context = sizedContext(this.canvas);
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const { map, duration } = this;
    const inner = { width: width - MARGIN.left - MARGIN.right, height: height - MARGIN.top - MARGIN.bottom };
    const x = (seconds) => MARGIN.left + (seconds / duration) * inner.width;
    const y = (value) => MARGIN.top + ((map.high - value) / (map.high - map.low)) * inner.height;
    context.clearRect(0, 0, width, height);
    context.drawImage(this.picture, x(map.start_s), MARGIN.top, x(map.end_s) - x(map.start_s), inner.height);
    if (ridgeColours) this.drawRidges(context, x, y, ridgeColours);
    this.drawAxes(context, x, y, inner);
    context.fillStyle = "#f33";
    context.fillRect(x(time) - 1, MARGIN.top, 2, inner.height);
  }

  drawRidges(context, x, y, colours) {
    this.map.ridges.forEach((ridge, number) => {
      context.fillStyle = colours[number];
      const step = (this.map.end_s - this.map.start_s) / ridge.length;
      ridge.forEach((value, column) => {
        if (value !== null) context.fillRect(x(this.map.start_s + (column + 0.5) * step) - 1, y(value) - 1, 2, 2);
      });
    });
  }

  drawAxes(context, x, y, inner) {
    const { map, duration } = this;
    const right = MARGIN.left + inner.width;
    const ink = getComputedStyle(document.body).color;
    context.fillStyle = ink;
    context.font = "12px system-ui, sans-serif";
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (const [value, text] of ticksBetween(map.low, map.high, 6)) {
      context.fillRect(MARGIN.left - 4, y(value), 4, 1);
      context.fillText(text, MARGIN.left - 7, y(value));
    }
    context.textAlign = "left";
    if (map.second_axis) {
      const factor = map.second_axis.per_unit;
      for (const [value, text] of ticksBetween(map.low * factor, map.high * factor, 6)) {
        // Ticks within the map: beside the numbers they look like minus signs.
        context.fillStyle = "white";
        context.fillRect(x(map.end_s) - 5, y(value / factor), 5, 1);
        context.fillStyle = ink;
        context.fillText(text, right + 5, y(value / factor));
      }
      this.drawUpright(context, map.second_axis.label, right + 43, inner);
    }
    context.textAlign = "center";
    context.textBaseline = "top";
    for (const [value, text] of ticksBetween(0, duration, inner.width / 80)) {
      context.fillRect(x(value), MARGIN.top + inner.height, 1, 4);
      context.fillText(`${text} s`, x(value), MARGIN.top + inner.height + 6);
    }
    this.drawUpright(context, map.axis, 9, inner);
  }

  drawUpright(context, text, left, inner) {
    context.save();
    context.translate(left, MARGIN.top + inner.height / 2);
    context.rotate(-Math.PI / 2);
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.fillText(text, 0, 0, inner.height);
    context.restore();
  }
}
