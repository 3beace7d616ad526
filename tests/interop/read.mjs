// Reads MCAP files with @mcap/core, by the index and as a stream, checking every CRC, decodes every
// message with @foxglove/rosmsg2-serialization, encodes it again and compares the bytes.
// Prints one line of JSON a file; exits with 1 where anything is wrong.
//
//     node read.mjs FILE...
import { open, readFile } from "node:fs/promises";

import { parse } from "@foxglove/rosmsg";
import { MessageReader, MessageWriter } from "@foxglove/rosmsg2-serialization";
import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { decompress } from "fzstd";

const decompressHandlers = { zstd: (data) => decompress(data) };

class FileReadable {
  constructor(handle, size) {
    this.handle = handle;
    this.bytes = size;
  }

  async size() {
    return BigInt(this.bytes);
  }

  async read(offset, length) {
    const data = new Uint8Array(Number(length));
    let done = 0;
    while (done < data.length) {
      const { bytesRead } = await this.handle.read(data, done, data.length - done, Number(offset) + done);
      if (bytesRead === 0) throw new Error("read beyond the end of the file");
      done += bytesRead;
    }
    return data;
  }
}

class Codecs {
  constructor() {
    this.known = new Map();
  }

  of(schema) {
    if (!this.known.has(schema.id)) {
      const definitions = parse(new TextDecoder().decode(schema.data), { ros2: true });
      this.known.set(schema.id, [new MessageReader(definitions), new MessageWriter(definitions)]);
    }
    return this.known.get(schema.id);
  }
}

function check(channel, schema, message, codecs, problems) {
  const fail = (what) => problems.add(`${channel.topic}: ${what}`);
  if (channel.messageEncoding !== "cdr") fail(`message encoding ${channel.messageEncoding}`);
  if (!channel.metadata.has("offered_qos_profiles")) fail("no offered_qos_profiles");
  if (schema == undefined) return fail("no schema");
  if (schema.encoding !== "ros2msg") fail(`schema encoding ${schema.encoding}`);
  if (!/^[a-z][a-z0-9_]*\/msg\/[A-Z][A-Za-z0-9]*$/.test(schema.name)) fail(`schema name ${schema.name}`);
  const [reader, writer] = codecs.of(schema);
  const again = writer.writeMessage(reader.readMessage(message.data));
  if (Buffer.compare(Buffer.from(again), Buffer.from(message.data)) !== 0) fail("encodes to other bytes");
}

async function byIndex(path, problems) {
  const handle = await open(path);
  try {
    const { size } = await handle.stat();
    const reader = await McapIndexedReader.Initialize({
      readable: new FileReadable(handle, size),
      decompressHandlers,
    });
    const codecs = new Codecs();
    const counts = {};
    for await (const message of reader.readMessages({ validateCrcs: true })) {
      const channel = reader.channelsById.get(message.channelId);
      check(channel, reader.schemasById.get(channel.schemaId), message, codecs, problems);
      counts[channel.topic] = (counts[channel.topic] ?? 0) + 1;
    }
    const attachments = [];
    for await (const item of reader.readAttachments({ validateCrcs: true })) attachments.push(item.name);
    const total = Object.values(counts).reduce((sum, count) => sum + count, 0);
    if (Number(reader.statistics?.messageCount) !== total) problems.add("the statistics count otherwise");
    return { profile: reader.header.profile, library: reader.header.library, counts, attachments };
  } finally {
    await handle.close();
  }
}

async function asStream(path) {
  const reader = new McapStreamReader({ validateCrcs: true, decompressHandlers });
  reader.append(new Uint8Array(await readFile(path)));
  const counts = {};
  const topics = new Map();
  for (let record; (record = reader.nextRecord()); ) {
    if (record.type === "Channel") topics.set(record.id, record.topic);
    if (record.type === "Message") {
      const topic = topics.get(record.channelId);
      counts[topic] = (counts[topic] ?? 0) + 1;
    }
  }
  if (!reader.done()) throw new Error("the stream does not end as a file should");
  return counts;
}

let failed = false;
for (const path of process.argv.slice(2)) {
  const problems = new Set();
  let found = {};
  try {
    found = await byIndex(path, problems);
    found.stream = await asStream(path);
    if (found.profile !== "ros2") problems.add(`profile ${found.profile}`);
    if (!found.library) problems.add("no library");
  } catch (error) {
    problems.add(String(error));
  }
  failed ||= problems.size > 0;
  console.log(JSON.stringify({ path, ...found, problems: [...problems] }));
}
process.exit(failed ? 1 : 0);
