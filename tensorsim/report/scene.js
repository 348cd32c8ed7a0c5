// People, radar and wall in world coordinates: x to the right, y away from the radar, z up, in metres.
class Scene3D {
  constructor(canvas, people, scene) {
    this.canvas = canvas;
    this.people = people;
    this.scene = scene;
    const bytes = bytesOf(people.joints_cm);
    this.joints = new Int16Array(bytes.buffer, 0, bytes.length / 2);
    this.valid = bytesOf(people.valid);
    this.frames = people.count ? this.valid.length / people.count : 0;
    this.yaw = -0.6;
    this.pitch = 0.35;
    this.zoom = 1;
    this.measure();
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      if (!event.buttons) return;
      this.yaw += event.movementX * 0.008;
      this.pitch = Math.min(1.5, Math.max(0, this.pitch + event.movementY * 0.008));
      this.draw(this.frame);
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom = Math.min(8, Math.max(0.3, this.zoom * Math.exp(-event.deltaY * 0.001)));
      this.draw(this.frame);
    }, { passive: false });
  }

  joint(person, frame, joint) {
    const at = ((person * this.frames + frame) * 14 + joint) * 3;
    return [this.joints[at] / 100, this.joints[at + 1] / 100, this.joints[at + 2] / 100];
  }

  isThere(person, frame) {
    return this.valid[person * this.frames + frame] === 1;
  }

  // The box around the radar and all hips, which the view is centred on.
  measure() {
    const antennas = (axis) => this.scene.antennas_m.map((antenna) => antenna[axis]);
    this.low = [-1, 0, 0].map((least, axis) => Math.min(least, ...antennas(axis)));
    this.high = [1, 2, 2].map((most, axis) => Math.max(most, ...antennas(axis)));
    for (let person = 0; person < this.people.count; person++) {
      for (let frame = 0; frame < this.frames; frame++) {
        if (!this.isThere(person, frame)) continue;
        const hip = this.joint(person, frame, 8);
        for (const axis of [0, 1]) {
          this.low[axis] = Math.min(this.low[axis], hip[axis] - 0.5);
          this.high[axis] = Math.max(this.high[axis], hip[axis] + 0.5);
        }
      }
    }
    this.middle = this.low.map((low, axis) => (low + this.high[axis]) / 2);
    this.reach = Math.hypot(...this.low.map((low, axis) => this.high[axis] - low)) / 2;
  }

  project(point) {
    const [x, y, z] = point.map((value, axis) => value - this.middle[axis]);
    const across = x * Math.cos(this.yaw) + y * Math.sin(this.yaw);
    const along = -x * Math.sin(this.yaw) + y * Math.cos(this.yaw);
    const up = z * Math.cos(this.pitch) + along * Math.sin(this.pitch);
    const depth = 3 * this.reach + along * Math.cos(this.pitch) - z * Math.sin(this.pitch);
    const size = Math.min(0.6 * this.canvas.clientWidth, this.canvas.clientHeight);
    const scale = (2.4 * this.zoom * size) / Math.max(depth, 0.1);
    return [this.canvas.clientWidth / 2 + across * scale, this.canvas.clientHeight / 2 - up * scale];
  }

  line(context, from, to) {
    context.beginPath();
    context.moveTo(...this.project(from));
    context.lineTo(...this.project(to));
    context.stroke();
  }

  draw(frame) {
    this.frame = frame;
    const context = sizedContext(this.canvas);
    context.clearRect(0, 0, this.canvas.clientWidth, this.canvas.clientHeight);
    this.drawFloor(context);
    this.drawRadar(context);
    for (let person = 0; person < this.people.count; person++) this.drawPerson(context, person, frame);
  }

  drawFloor(context) {
    const [left, near] = [Math.floor(this.low[0]), Math.floor(this.low[1])];
    const [right, far] = [Math.ceil(this.high[0]), Math.ceil(this.high[1])];
    context.lineWidth = 1;
    context.strokeStyle = "#4a5560";
    for (let x = left; x <= right; x++) this.line(context, [x, near, 0], [x, far, 0]);
    for (let y = near; y <= far; y++) this.line(context, [left, y, 0], [right, y, 0]);
    context.fillStyle = "#9ab";
    context.font = "11px system-ui, sans-serif";
    for (let y = Math.max(1, near); y <= far; y++) context.fillText(`${y} m`, ...this.project([right + 0.1, y, 0]));
  }

  drawRadar(context) {
    context.fillStyle = "#fff";
    const places = this.scene.antennas_m.map((antenna) => this.project(antenna));
    for (const [x, y] of places) context.fillRect(x - 3, y - 3, 6, 6);
    context.fillText("radar", Math.max(...places.map(([x]) => x)) + 8, places[0][1] - 6);
    if (!this.scene.wall) return;
    const { center_m: center, size_m: size } = this.scene.wall;
    const corner = (signs) => center.map((value, axis) => value + (signs[axis] * size[axis]) / 2);
    context.strokeStyle = "#c96";
    for (const y0 of [-1, 1]) {
      const ring = [[-1, -1], [1, -1], [1, 1], [-1, 1]];
      ring.forEach(([x0, z0], index) => {
        const [x1, z1] = ring[(index + 1) % 4];
        this.line(context, corner([x0, y0, z0]), corner([x1, y0, z1]));
      });
    }
  }

  drawPerson(context, person, frame) {
    const colour = `rgb(${this.people.colours[person].join()})`;
    context.fillStyle = colour;
    for (let other = 0; other <= frame; other += 2) {
      if (!this.isThere(person, other)) continue;
      const [a, b] = [this.joint(person, other, 8), this.joint(person, other, 11)];
      const [x, y] = this.project([(a[0] + b[0]) / 2, (a[1] + b[1]) / 2, 0]);
      context.fillRect(x, y, 2, 2);
    }
    if (!this.isThere(person, frame)) return;
    context.strokeStyle = colour;
    context.lineWidth = 3;
    context.lineCap = "round";
    for (const [from, to] of this.people.bones) {
      this.line(context, this.joint(person, frame, from), this.joint(person, frame, to));
    }
    const head = this.project(this.joint(person, frame, 0));
    context.beginPath();
    context.arc(head[0], head[1], 5, 0, 2 * Math.PI);
    context.fill();
    context.fillText(`${this.people.numbers[person]}`, head[0] + 8, head[1] - 6);
  }
}
