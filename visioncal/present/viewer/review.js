"use strict";

// Shows the recording that this page's server hands out. Nothing is kept in the browser.
async function show() {
  await wasm_bindgen({ module_or_path: "re_viewer_bg.wasm" });
  const viewer = new wasm_bindgen.WebHandle({
    url: [new URL("recording.rrd", location.href).href],
    hide_welcome_screen: true,
    enable_history: false,
    notebook: false,
    persist: false,
  });
  await viewer.start(document.getElementById("viewer"));
  document.getElementById("status").remove();
  await seek(viewer);
  addEventListener("hashchange", () => seek(viewer));
}

// Goes to the place on a timeline that the address names: #when=view@7.
async function seek(viewer) {
  const [, timeline, place] = /^#when=(\w+)@(\d+)$/.exec(location.hash) ?? [];
  // A recording that is still being loaded has no such timeline yet.
  for (let tries = 0; timeline && tries < 300; tries += 1) {
    try {
      await viewer.viewer_control(cursorRequest(timeline, Number(place)));
      return;
    } catch {
      await new Promise((done) => setTimeout(done, 100));
    }
  }
}

// A ViewerControlRequest that sets the time cursor and pauses, as protocol buffers have it.
function cursorRequest(timeline, place) {
  const part = (field, bytes) => [(field << 3) | 2, bytes.length, ...bytes];
  const name = part(1, [...new TextEncoder().encode(timeline)]);
  const paused = [5 << 3, 1];
  return new Uint8Array(part(6, [...part(2, name), ...part(3, [1 << 3, ...varint(place)]), ...paused]));
}

function varint(value) {
  return value < 128 ? [value] : [(value & 127) | 128, ...varint(value >> 7)];
}

show().catch((error) => {
  const status = document.getElementById("status");
  if (status) status.textContent = `The viewer cannot be shown: ${error}`;
});
