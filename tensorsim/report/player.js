// The film: pictures inside the page, or a film beside it.
class Film {
  constructor(holder, film, fps) {
    this.fps = fps;
    if (film.beside) {
      this.video = holder.appendChild(document.createElement("video"));
      this.video.muted = true;
      this.video.preload = "auto";
      this.video.addEventListener("error", () => {
        holder.querySelector("figcaption").textContent = `Film (${film.beside} cannot be read beside this page)`;
      });
      this.video.src = film.beside;
      return;
    }
    this.canvas = holder.appendChild(document.createElement("canvas"));
    [this.canvas.width, this.canvas.height] = [film.width, film.height];
    this.pictures = film.pictures.map((data) => {
      const image = new Image();
      image.src = `data:image/jpeg;base64,${data}`;
      image.addEventListener("load", () => this.shown === image && this.paint(image));
      return image;
    });
  }

  paint(image) {
    if (image.complete) this.canvas.getContext("2d").drawImage(image, 0, 0, this.canvas.width, this.canvas.height);
  }

  play(playing, speed) {
    if (!this.video) return;
    this.video.playbackRate = speed;
    if (playing) this.video.play().catch(() => {}); // without its file the maps play alone
    else this.video.pause();
  }

  show(time, frame) {
    if (this.video) {
      const late = Math.abs(this.video.currentTime - time);
      if (!this.video.seeking && late > (this.video.paused ? 0.5 / this.fps : 0.15)) this.video.currentTime = time;
      return;
    }
    this.shown = this.pictures[Math.min(frame, this.pictures.length - 1)];
    if (this.shown) this.paint(this.shown);
  }
}

const element = (id) => document.getElementById(id);

function tableOf(holder, headings, rows) {
  const table = holder.appendChild(document.createElement("table"));
  const add = (cells, kind) => {
    const line = table.insertRow();
    for (const cell of cells) line.appendChild(document.createElement(kind)).textContent = cell;
  };
  add(headings, "th");
  for (const row of rows) add(row, "td");
}

function describe(content) {
  const { summary } = content;
  element("label").textContent = summary.label || "No label";
  element("title").textContent = content.title;
  for (const warning of summary.warnings || []) {
    element("warnings").appendChild(document.createElement("li")).textContent = warning;
  }
  const labelled = summary.people.some((row) => row.label);
  tableOf(
    element("people"),
    ["person", "from", "to", "mean range", "mean approach", ...(labelled ? ["label alone"] : [])],
    summary.people.map((row) => [
      row.id,
      `${(row.first_frame / content.fps).toFixed(2)} s`,
      `${(row.last_frame / content.fps).toFixed(2)} s`,
      `${fixed(row.mean_range_m, 2)} m`,
      `${fixed(row.mean_approach_m_s, 2)} m/s`,
      ...(labelled ? [row.label || ""] : []),
    ]),
  );
  const ranked = Object.entries(summary.probabilities || {}).sort((a, b) => b[1] - a[1]);
  tableOf(element("activities"), ["activity", "probability"], ranked.map(([name, p]) => [name, p.toFixed(3)]));
  element("configuration").textContent = JSON.stringify(summary.config, null, 2);
}

function drawTimeline(content, seek) {
  const holder = element("timeline");
  const names = Object.keys(content.summary.probabilities || {});
  for (const part of content.timeline) {
    const box = holder.appendChild(document.createElement("div"));
    box.style.left = `${(100 * part.start_s) / content.duration_s}%`;
    box.style.width = `${(100 * (part.end_s - part.start_s)) / content.duration_s}%`;
    const hue = (360 * Math.max(0, names.indexOf(part.label))) / Math.max(1, names.length);
    box.style.background = `hsl(${hue} 55% ${55 - 25 * part.probability}%)`;
    box.textContent = `${part.label} ${Math.round(100 * part.probability)} %`;
    box.title = box.textContent;
  }
  if (!content.timeline.length) return null;
  holder.addEventListener("pointerdown", (event) => {
    const place = holder.getBoundingClientRect();
    seek(((event.clientX - place.left) / place.width) * content.duration_s);
  });
  const cursor = holder.appendChild(document.createElement("div"));
  cursor.className = "cursor";
  return cursor;
}

async function start() {
  const content = JSON.parse(element("content").textContent);
  describe(content);
  const state = { time: 0, playing: false, before: 0 };
  const seek = (time) => {
    state.time = Math.min(Math.max(time, 0), content.duration_s);
    show();
  };
  const film = new Film(element("film"), content.film, content.fps);
  const scene = new Scene3D(element("scene"), content.people, content.scene);
  const cursor = drawTimeline(content, seek);
  const views = content.maps.map((map) => new MapView(element("maps"), map, content.duration_s, seek));
  await Promise.all(views.map((view) => view.load()));

  for (const name of Object.keys(content.colourmaps)) element("colours").add(new Option(name, name));
  element("colours").value = content.style.colormap;
  const range = content.style.dynamic_range_db;
  Object.assign(element("range"), { min: Math.min(10, range), max: content.maps[0].stored_db, value: range });
  element("ridges").checked = content.style.ridges;
  element("time").max = content.duration_s;

  function show() {
    const frame = Math.min(Math.floor(state.time * content.fps + 1e-6), content.frames - 1);
    film.show(state.time, frame);
    scene.draw(frame);
    const ridgeColours = element("ridges").checked ? content.ridge_colours : null;
    for (const view of views) view.draw(state.time, ridgeColours);
    element("time").value = state.time;
    element("clock").textContent = `${state.time.toFixed(2)} s`;
    if (cursor) cursor.style.left = `${(100 * state.time) / content.duration_s}%`;
  }
  function colour() {
    const table = bytesOf(content.colourmaps[element("colours").value]);
    for (const view of views) view.colour(table, Number(element("range").value));
    element("rangeValue").textContent = `${element("range").value} dB`;
    show();
  }
  function play(playing) {
    state.playing = playing;
    element("play").textContent = playing ? "Pause" : "Play";
    if (playing && state.time >= content.duration_s) state.time = 0;
    state.before = performance.now();
    film.play(playing, Number(element("speed").value));
    if (playing) requestAnimationFrame(tick);
  }
  function tick(now) {
    if (!state.playing) return;
    seek(state.time + (Math.max(0, now - state.before) / 1000) * Number(element("speed").value));
    state.before = now;
    if (state.time >= content.duration_s) play(false);
    else requestAnimationFrame(tick);
  }
  element("play").addEventListener("click", () => play(!state.playing));
  element("time").addEventListener("input", () => seek(Number(element("time").value)));
  for (const id of ["colours", "range"]) element(id).addEventListener("input", colour);
  element("ridges").addEventListener("input", show);
  element("speed").addEventListener("input", () => film.play(state.playing, Number(element("speed").value)));
  window.addEventListener("resize", show);
  colour();
  document.body.dataset.ready = "yes";
}

start();
