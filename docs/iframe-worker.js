// Browsers allow no workers on pages that are opened as files. The theme's search then runs in a hidden frame instead.
if (location.protocol === "file:") {
  window.IFrameWorker = window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      const frame = document.createElement("iframe")
      frame.hidden = true
      document.body.append(frame)
      this.inside = frame.contentWindow
      const page = this.inside.document
      page.open()
      this.inside.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }))
      this.inside.importScripts = async (...scripts) => {
        for (const src of scripts)
          await new Promise((resolve, reject) =>
            page.body.append(Object.assign(page.createElement("script"), { src, onload: resolve, onerror: reject })))
      }
      this.ready = new Promise((resolve) => frame.addEventListener("load", resolve))
      page.write(`<body><script src="${url}"></` + "script></body>")
      page.close()
    }

    async postMessage(data) {
      await this.ready
      this.inside.dispatchEvent(new MessageEvent("message", { data }))
    }
  }
}
