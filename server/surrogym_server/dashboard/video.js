// The video of a policy: its best, median and worst real episode beside each other.

import { bytes } from "/page/api.js";
import { h } from "/page/dom.js";
import { number } from "/page/format.js";

const FORMS = ["mp4", "gif"];
const AT_ONCE = 2e6; // bytes: a larger one is fetched on demand
const ALT = "The best, the median and the worst real episode beside each other";

/** {element, close}; `url` is the policy's. What is missing or broken is said in its place. */
export function videoPart(url, { files }) {
  const place = h("div", {});
  const file = FORMS.map((form) => files.find((one) => one.form === form && one.stored)).find(Boolean);
  let address = null;
  const fail = (words) => place.replaceChildren(h("p", { class: "bad", role: "alert" }, words));

  async function load() {
    place.replaceChildren(h("p", { class: "note" }, "Fetching the video…"));
    try {
      address = URL.createObjectURL(await bytes(`${url}/files/${file.form}`));
      const failed = () => fail("The video can't be played: its file is broken, or this browser does not know its form. It can be downloaded above.");
      place.replaceChildren(file.form === "gif"
        ? h("img", { class: "video", src: address, alt: ALT, onerror: failed })
        : h("video", { class: "video", src: address, controls: true, muted: true, playsinline: true, "aria-label": ALT, onerror: failed }));
    } catch (error) {
      fail(`The video can't be shown: ${error.message}`);
    }
  }

  if (!file) place.append(h("p", { class: "note" }, "No video: ", h("code", {}, "surrogym evaluate --video"), " records one where the environment can be drawn."));
  else if (file.bytes > AT_ONCE) place.append(h("button", { type: "button", onclick: load }, `Show the video, ${number(file.bytes / 1e6)} MB`));
  else load();
  return {
    element: h("div", {}, file && h("h4", {}, "Video: the best, the median and the worst real episode"), place),
    close: () => address && URL.revokeObjectURL(address),
  };
}
