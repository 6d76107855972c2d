// Read a tileset by 3d-tiles-renderer: URL ERROR_TARGET. A camera looks at all of it from a distance, or for an error
// target of 0 everything is loaded. Each content is held against the Khronos validator of glTF.
// Prints JSON: points, box of what is shown (three's axes are the tileset's), contents, bytes, what the validator says.
import { createRequire, registerHooks } from 'node:module'
import { pathToFileURL } from 'node:url'

globalThis.self ??= globalThis
globalThis.window ??= { location: { href: process.argv[2] } }
globalThis.requestAnimationFrame ??= (call) => setTimeout(call, 0)
globalThis.cancelAnimationFrame ??= (id) => clearTimeout(id)
// Modules are looked for beside the file that names them; those of the tools lie elsewhere.
const parentURL = pathToFileURL(`${process.env.NODE_PATH}/here.mjs`).href
registerHooks({
  resolve: (name, context, next) => next(name, context.parentURL === import.meta.url ? { ...context, parentURL } : context),
})
const three = await import('three')
const { TilesRenderer } = await import('3d-tiles-renderer')
const validator = createRequire(parentURL)('gltf-validator')

const [url, errorTarget, key] = process.argv.slice(2)
const read = { contents: 0, bytes: 0, documents: 0, issues: [] }
const headers = key ? { Authorization: `Bearer ${key}` } : {}
const tiles = new TilesRenderer(url)
tiles.fetchOptions = { headers }
tiles.registerPlugin({
  fetchData: async (address, options) => {
    const answer = await fetch(address, { ...options, headers })
    if (!answer.ok) throw new Error(`${address}: ${answer.status}`)
    const bytes = new Uint8Array(await answer.clone().arrayBuffer())
    read.bytes += bytes.length
    if (!String(address).includes('.glb')) read.documents += 1
    else {
      read.contents += 1
      const report = await validator.validateBytes(bytes)
      read.issues.push(...report.issues.messages.map((one) => `${one.code}: ${one.message}`))
    }
    return answer
  },
})
tiles.errorTarget = Number(errorTarget)
tiles.addEventListener('load-error', ({ error }) => {
  console.error(String(error))
  process.exit(1)
})

const camera = new three.PerspectiveCamera(60, 4 / 3, 0.1, 1e9)
const sphere = new three.Sphere()
const look = () => {
  tiles.getBoundingSphere(sphere)
  camera.position.copy(sphere.center).add(new three.Vector3(0, 0, 2.2 * sphere.radius))
  camera.lookAt(sphere.center)
  camera.updateMatrixWorld()
}
tiles.setCamera(camera)
tiles.setResolution(camera, 800, 600)
for (let quiet = 0; quiet < 50; ) {
  if (tiles.root) look()
  tiles.update()
  await new Promise((resolve) => setTimeout(resolve, 5))
  quiet = tiles.root && tiles.loadProgress === 1 ? quiet + 1 : 0
}
let points = 0
const box = new three.Box3()
tiles.group.updateMatrixWorld(true)
const colours = new Set()
tiles.group.traverse((one) => {
  if (!one.isPoints) return
  points += one.geometry.attributes.position.count
  for (const name of Object.keys(one.geometry.attributes)) colours.add(name)
  box.expandByObject(one, true)
})
const issues = [...new Set(read.issues)]
console.log(JSON.stringify({ ...read, issues, points, box: [box.min, box.max].map((one) => one.toArray()), attributes: [...colours].sort() }))
process.exit(0)
