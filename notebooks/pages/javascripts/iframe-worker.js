// Browsers refuse workers to pages that are read from disk. The search then runs in a hidden frame of the page instead.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      const frame = document.createElement("iframe")
      frame.hidden = true
      document.body.append(frame)
      const inner = frame.contentWindow
      const base = new URL(url, location).href
      // what the worker posts reaches the page; what the page posts reaches the worker once it has been read
      inner.postMessage = data => {
        this.dispatchEvent(new MessageEvent("message", { data }))
      }
      inner.importScripts = (...addresses) => Promise.all(addresses.map(address => load(address)))
      const load = address =>
        new Promise((done, failed) => {
          const script = inner.document.createElement("script")
          script.src = new URL(address, base).href
          script.onload = done
          script.onerror = failed
          inner.document.body.append(script)
        })
      this.ready = load(base)
      this.inner = inner
    }

    postMessage(data) {
      this.ready.then(() => this.inner.dispatchEvent(new MessageEvent("message", { data })))
    }

    terminate() {
      this.inner.frameElement.remove()
    }
  }
}
