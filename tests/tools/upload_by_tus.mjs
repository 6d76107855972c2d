// Upload by tus-js-client: URL FILE STATE STOP_AT. Stops after STOP_AT bytes (0: none) and goes on from STATE later.
// Prints the address of the upload.
import { createReadStream, statSync } from 'node:fs'
import { createRequire } from 'node:module'

const require = createRequire(`${process.env.NODE_PATH}/`)
const tus = require('tus-js-client')
const [url, file, state, stopAt] = process.argv.slice(2)
const upload = new tus.Upload(createReadStream(file), {
  endpoint: `${url}/uploads`,
  chunkSize: 100_000,
  uploadSize: statSync(file).size,
  urlStorage: new tus.FileUrlStorage(state),
  fingerprint: async () => 'hall',
  retryDelays: [0, 100, 300, 1000],
  metadata: { filename: 'hall.ply', device_id: 'robot-7', filetype: '' },
  onChunkComplete: (_size, accepted) => {
    if (Number(stopAt) && accepted >= Number(stopAt)) {
      console.log(upload.url)
      process.exit(0) // as a robot whose battery is empty
    }
  },
  onSuccess: () => {
    console.log(upload.url)
    process.exit(0)
  },
  onError: (error) => {
    console.error(String(error))
    process.exit(1)
  },
})
const previous = await upload.findPreviousUploads()
if (previous.length) upload.resumeFromPreviousUpload(previous[0])
upload.start()
