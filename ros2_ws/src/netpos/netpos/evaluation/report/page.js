// Controls of a report: which devices are shown, and where they were at a time.
"use strict";

const plotsOf = (section) => [...section.querySelectorAll(".js-plotly-plot")];

// Hide or show the lines of a device in all plots of its recording.
function show(section, device, shown) {
  for (const plot of plotsOf(section)) {
    const lines = plot.data.flatMap((line, i) => (line.meta === device ? [i] : []));
    if (lines.length) Plotly.restyle(plot, { visible: shown }, lines);
  }
}

// Points of a circle, then a gap, so that many circles are one line.
function circle(x, y, radius) {
  const points = [];
  for (let i = 0; i <= 32; i++) {
    const turn = (2 * Math.PI * i) / 32;
    points.push([x + radius * Math.cos(turn), y + radius * Math.sin(turn)]);
  }
  return [...points, [null, null]];
}

// Move the marks of the map to moment k: estimates, true places, protection levels.
function moveTo(section, moments, k) {
  const map = section.querySelector(".map .js-plotly-plot");
  const shown = moments.devices.filter((device) => {
    const box = section.querySelector(`input[data-device="${CSS.escape(device.name)}"]`);
    return !box || box.checked;
  });
  const here = shown.filter((device) => device.x[k] !== null);
  const levels = here
    .filter((device) => device.level[k] !== null)
    .flatMap((device) => circle(device.x[k], device.y[k], device.level[k]));
  const marks = {
    estimate: here.map((device) => [device.x[k], device.y[k]]),
    truth: shown.filter((device) => device.true_x[k] !== null).map((d) => [d.true_x[k], d.true_y[k]]),
    level: levels,
  };
  const lines = Object.keys(marks).map((name) => map.data.findIndex((line) => line.meta === `now ${name}`));
  const column = (i) => Object.values(marks).map((points) => points.map((point) => point[i]));
  Plotly.restyle(map, { x: column(0), y: column(1) }, lines);
  const states = here.map((device) => `${device.name} ${device.state[k]}`).join(", ");
  section.querySelector("output").value = `${moments.t[k].toFixed(1)} s: ${states || "no estimate"}`;
}

for (const section of document.querySelectorAll("section")) {
  for (const box of section.querySelectorAll("input[data-device]")) {
    box.addEventListener("change", () => {
      show(section, box.dataset.device, box.checked);
      section.querySelector(".time")?.dispatchEvent(new Event("input"));
    });
  }
  const slider = section.querySelector(".time");
  if (!slider) continue;
  const moments = JSON.parse(section.querySelector(".moments").textContent);
  const button = section.querySelector(".play");
  let timer = null;
  const stop = () => {
    clearInterval(timer);
    timer = null;
    button.textContent = "Play";
  };
  slider.addEventListener("input", () => moveTo(section, moments, Number(slider.value)));
  button.addEventListener("click", () => {
    if (timer) return stop();
    if (slider.value === slider.max) slider.value = slider.min;
    button.textContent = "Pause";
    timer = setInterval(() => {
      slider.stepUp();
      slider.dispatchEvent(new Event("input"));
      if (slider.value === slider.max) stop();
    }, 60);
  });
  moveTo(section, moments, 0);
}
