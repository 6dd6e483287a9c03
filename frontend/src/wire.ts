// Made by tools/make_typescript.py from fringescope.wire; change it there.

/** A guest comes in. */
export interface Accept {
  token: string;
  code: string;
}

/** Who is signed in here; `csrf` goes into the header X-CSRF-Token of whatever changes something. */
export interface Account {
  person: Person;
  csrf: string;
  local: boolean;
  case?: string | null;
}

/** The operator goes on although the specimen has been suspect since then, `suspect` of the standing: a browser's numbers cannot hold its nanoseconds. */
export interface Acknowledge {
  kind: "acknowledge";
  suspect: string;
}

/** The operator, at the instrument, confirms what the preview showed. */
export interface Arm {
  kind: "arm";
  version: number;
  content: string;
  pattern: string;
}

/** A stale version whose strokes are to be laid on the present scan. */
export interface AskedCarry {
  version: number;
}

/** Two scans of a case, and the version whose lines the cut should have followed. */
export interface AskedCompare {
  before: string;
  after: string;
  version?: number | null;
}

/** A case to erase, and why: a request, a rule, the end of a study. */
export interface AskedErasure {
  why: string;
}

/** What a check of the log found. */
export interface AuditReport {
  cases: number;
  events: number;
  faults: string[];
  whole: boolean;
  checkpoints?: number;
  covered_ns?: number;
}

/** The operator takes the strokes of a stale version over to the present scan, as job `job` has laid them there. */
export interface CarryOver {
  kind: "carry_over";
  version: number;
  scan: string;
  job: string;
}

/** An examination. */
export interface Case {
  id: string;
  accession: string;
  status: Status;
  specimen: Specimen;
  patient?: Patient | null;
  created_ns: number;
  changed_ns: number;
  scans: number;
  seq: number;
}

/** What changes of a case; what is missing stays. */
export interface CaseChange {
  status?: "open" | "done" | "archived" | null;
  specimen?: Specimen | null;
  patient?: Patient | null;
}

/** Some of the cases, and how many fit the question. */
export interface CaseList {
  total: number;
  cases: Case[];
}

/** Where a case stands after event `seq`. */
export interface CaseState {
  seq: number;
  standing: Record<string, unknown>;
  strokes: Record<string, Record<string, unknown>>;
  layers: Record<string, Record<string, unknown>>;
  comments: Record<string, Record<string, unknown>>;
  versions: Record<string, Record<string, unknown>[]>;
  scans: string[];
}

/** All that was there when you came was sent. */
export interface CaughtUp {
  type: "caught_up";
  seq: number;
}

/** Words for the others, about a stroke, a version, a place (world mm) or nothing in particular. */
export interface Comment {
  kind: "comment";
  comment: string;
  text: string;
  stroke?: string | null;
  version?: number | null;
  place_mm?: [number, number, number] | null;
}

/** The password once more. */
export interface Confirm {
  password: string;
}

/** It is done. */
export interface Ended {
  done?: string;
}

/** A case was erased: so many events lost their words, so many files are gone. */
export interface Erased {
  events: number;
  files: number;
}

/** An event of the log, in its order and each once. */
export interface Event {
  type: "event";
  seq: number;
  at_ns: number;
  actor: string;
  role: string;
  client: string;
  number: number;
  kind: string;
  refused: string;
  payload: Record<string, unknown> | null;
  hash: string;
}

export type FromClient = Say | Pointer | View | Ink | Ping;

export type FromServer = Welcome | Event | CaughtUp | Said | Standing | Warned | Relayed | Presence | Pong | Refusal;

/** The hub lives; `room`: there is a gigabyte left on its disk. */
export interface Health {
  version: string;
  room: boolean;
}

/** A piece of a stroke that is being drawn: never kept; the finished one comes as an op. */
export interface Ink {
  type: "ink";
  stroke: string;
  camera?: string | null;
  points: number[][];
  color?: string;
}

/** The instrument, as the operator's screen shows it. */
export interface InstrumentState {
  uri: string;
  there: boolean;
  busy: string;
  projecting: string | null;
  guarded: boolean;
  case: string | null;
  why?: string;
}

/** An invitation; `token` and `code` are there only in the answer that made it. */
export interface Invitation {
  id: string;
  case: string;
  role: PersonRole;
  name: string;
  expires_ns: number;
  revoked: boolean;
  used_ns?: number | null;
  token?: string | null;
  code?: string | null;
}

/** Work that takes long. */
export interface Job {
  id: string;
  kind: string;
  case: string | null;
  state: JobState;
  stage: string;
  share: number;
  why?: string;
  result?: Record<string, unknown> | null;
  created_ns: number;
  ended_ns?: number | null;
}

/** How far a job is. */
export type JobState = "waiting" | "running" | "done" | "failed" | "cancelled";

/** What navigator.credentials gave back (PublicKeyCredential.toJSON()); a name for the key where it is new. */
export interface KeyAnswer {
  credential: Record<string, unknown>;
  label?: string;
}

/** What a page hands to navigator.credentials.create or .get, as `publicKey`; good once, and not for long. */
export interface KeyOptions {
  options: Record<string, unknown>;
}

/** A layer is made, renamed or hidden for everybody, by its author. */
export interface Layer {
  kind: "layer";
  layer: string;
  name: string;
  hidden?: boolean;
}

/** Name and password. */
export interface Login {
  name: string;
  password: string;
}

/** A case to open: at least an accession number or the barcode on the vessel. */
export interface NewCase {
  accession: string;
  specimen?: Specimen;
  patient?: Patient | null;
}

/** Somebody invited to one case, by a link and a code that is told by another way. */
export interface NewInvitation {
  role?: "expert" | "observer";
  name: string;
  hours?: number;
}

/** An account to make: of who signs in by a password, by the identity provider (`subject`: who they are there). */
export interface NewPerson {
  name: string;
  password?: string | null;
  role: PersonRole;
  subject?: string | null;
}

/** A pose of the calibration board; the first of a session says which board it is, as its board.json does. */
export interface NewPose {
  board?: Record<string, unknown> | null;
}

/** A scan to take. */
export interface NewScan {
  label?: string;
}

/** The `number`-th op (1, 2, ..) of `client`, which is one program from its start to its end. Said twice it is done once: the second time the answer of the first comes back. */
export interface Op {
  client: string;
  number: number;
  at_ns?: number;
  what: Put | Remove | Layer | Comment | Withdraw | Undo | Submit | Sign | Preview | Arm | Start | Acknowledge | Stop | CarryOver;
}

/** A passkey of somebody: its public half is all that the hub has. */
export interface Passkey {
  id: string;
  label: string;
  created_ns: number;
}

/** The old password, and the new one. */
export interface PasswordChange {
  old: string;
  new: string;
}

/** Who a specimen is from: kept apart from the log, and erased on request. */
export interface Patient {
  name?: string;
  identifier?: string;
  born?: string;
}

/** Somebody with an account. */
export interface Person {
  id: string;
  name: string;
  role: PersonRole;
  disabled?: boolean;
  created_ns?: number;
}

/** What changes of an account; what is missing stays. */
export interface PersonChange {
  name?: string | null;
  password?: string | null;
  role?: PersonRole | null;
  disabled?: boolean | null;
}

/** What somebody may do; `server.rights` says what exactly. */
export type PersonRole = "operator" | "expert" | "observer" | "admin";

/** Is anybody there? */
export interface Ping {
  type: "ping";
  at_ms?: number;
}

/** Where somebody points, while they do: never kept. */
export interface Pointer {
  type: "pointer";
  camera?: string | null;
  pixel?: [number, number] | null;
  world_mm?: [number, number, number] | null;
}

/** Somebody is. */
export interface Pong {
  type: "pong";
  at_ms: number;
}

/** Who is in the room now. */
export interface Presence {
  type: "presence";
  present: string[];
}

/** The operator, at the instrument, asks to see how a version will look, before they arm it. */
export interface Preview {
  kind: "preview";
  version: number;
}

/** What went wrong, in a sentence for the screen: what came, what was needed, what to do. */
export interface Problem {
  detail: string;
}

/** A stroke drawn, or changed by its author; `meaning` is what it stands for. */
export interface Put {
  kind: "put";
  stroke: StrokeDocument;
  scan: string;
  layer?: string;
  meaning?: "cut" | "avoid" | "sample" | "margin" | "ink" | "note";
}

/** A message that could not be taken, and why, in a sentence for the screen. */
export interface Refusal {
  type: "refusal";
  why: string;
}

/** What somebody else points at, sees or draws right now. */
export interface Relayed {
  type: "relayed";
  person: string;
  what: Pointer | View | Ink;
}

/** The author takes a stroke out of their draft. */
export interface Remove {
  kind: "remove";
  stroke: string;
}

/** What became of your op: its event, or why there is none (`refused`, a sentence for the screen). */
export interface Said {
  type: "said";
  client: string;
  number: number;
  seq: number | null;
  refused?: string;
}

/** An op for the log. */
export interface Say {
  type: "say";
  op: Op;
}

/** A file of a scan, by its content: it never changes, so it may be kept for good. */
export interface ScanFile {
  name: string;
  sha256: string;
  size: number;
  type: string;
}

/** A scan of a case. */
export interface ScanInfo {
  id: string;
  case: string;
  rig: string;
  label: string;
  taken_ns: number;
  files: ScanFile[];
  figures: Record<string, unknown>;
}

/** A person signs a version: name, time and meaning are bound to its content. Needs the password again. */
export interface Sign {
  kind: "sign";
  version: number;
  content: string;
  meaning: "proposed" | "approved" | "done as drawn" | "not done";
}

/** What lies under the cameras. Who it is from is kept apart and shown to operators alone. */
export interface Specimen {
  pseudonym?: string;
  organ?: string;
  side?: string;
  kind?: string;
  notes?: string;
}

/** How far each version has come, and whether the specimen is still as it was scanned. */
export interface Standing {
  type: "standing";
  seq: number;
  state: Record<string, unknown>;
}

/** The operator, at the instrument, turns on the light. */
export interface Start {
  kind: "start";
  version: number;
  pattern: string;
}

/** Where a case stands. */
export type Status = "open" | "done" | "archived" | "erased";

/** Dark: one version, or whatever is armed or projected. Anybody, from anywhere, at any time. */
export interface Stop {
  kind: "stop";
  version?: number | null;
  why?: string;
}

/** One stroke as in a guidelines file: in pixels (n, 2) of a camera, or at world_mm (n, 3). */
export interface StrokeDocument {
  id: string;
  kind?: "line" | "region" | "circle" | "arrow" | "offsets" | "text";
  camera?: string | null;
  pixels?: [number, number][] | null;
  world_mm?: [number, number, number][] | null;
  width_mm?: number | null;
  width_px?: number | null;
  color?: string;
  closed?: boolean;
  fill?: "none" | "solid" | "hatch";
  spacing_mm?: number;
  count?: number;
  side?: "left" | "right" | "both";
  radius_mm?: number | null;
  head_mm?: number | null;
  text?: string;
  size_mm?: number;
}

/** The author asks for exactly these strokes, identifier and content each, on this scan and rig. */
export interface Submit {
  kind: "submit";
  strokes: [string, string][];
  scan: string;
  rig: string;
}

/** The author takes back what event `of` did; None: their last op that can be. An undo of an undo does it again. */
export interface Undo {
  kind: "undo";
  of?: number | null;
}

/** From where somebody looks at the surface: never kept. */
export interface View {
  type: "view";
  eye_mm: [number, number, number];
  target_mm: [number, number, number];
  up: [number, number, number];
}

/** For the operator, with a sound. */
export interface Warned {
  type: "warned";
  text: string;
}

/** How one may sign in here; `provider` is the page to open for the identity provider, None without one. */
export interface Ways {
  passwords?: boolean;
  passkeys?: boolean;
  provider?: string | null;
}

/** The first message: who you are here, how far the log goes, who is in the room. `anew`: what you have is not in the log any more, as after a power cut; forget it, all events come again. */
export interface Welcome {
  type: "welcome";
  person: string;
  role: string;
  local: boolean;
  seq: number;
  present: string[];
  anew?: boolean;
}

export type WhatIsSaid = Put | Remove | Layer | Comment | Withdraw | Undo | Submit | Sign | Preview | Arm | Start | Acknowledge | Stop | CarryOver;

/** The author takes a comment back; the log keeps that it was there. */
export interface Withdraw {
  kind: "withdraw";
  comment: string;
}
