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
}

show().catch((error) => {
  document.getElementById("status").textContent = `The viewer cannot be shown: ${error}`;
});
