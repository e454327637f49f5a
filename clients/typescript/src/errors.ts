/** The errors of the protocol: one class for each `code` that a server or this client gives. */

/** The base class of all errors; its own code is `internal`, which stands for codes that this version does not know. */
export class VLAgentsError extends Error {
  /** The stable name of the error, to test for. */
  readonly code: string;
  /** Seconds after which another attempt is worth it; undefined if the server did not say. */
  readonly retryAfterS: number | undefined;

  constructor(detail: string, code = "internal", retryAfterS?: number) {
    super(detail);
    this.name = new.target.name;
    this.code = code;
    this.retryAfterS = retryAfterS;
  }
}

/** The request is wrong; sending it again does not help. */
export class InvalidInput extends VLAgentsError {}
export class MalformedMessage extends InvalidInput {}
export class MessageTooLarge extends InvalidInput {}
export class InvalidObservation extends InvalidInput {}
export class MissingCamera extends InvalidObservation {}
export class MissingState extends InvalidObservation {}
export class NotOffered extends InvalidObservation {}
/** The session expired, was closed, was never reset, or is at another step than its client knows. */
export class UnknownSession extends InvalidInput {}
export class UnknownApp extends InvalidInput {}
export class UnknownCheckpoint extends InvalidInput {}
export class NotReset extends InvalidInput {}
/** The robot and the policy do not fit together; the message lists every difference. */
export class ContractMismatch extends InvalidInput {}
export class Unauthorized extends InvalidInput {}
export class Forbidden extends InvalidInput {}
/** The rate or the sessions of the key are exceeded; nothing was executed. */
export class TooManyRequests extends VLAgentsError {}
/** The replica has no memory left for the request; nothing was executed. */
export class Overloaded extends VLAgentsError {}
/** The policy raised an error. */
export class PolicyFailed extends VLAgentsError {}
export class InvalidAction extends PolicyFailed {}
export class CheckpointFailed extends PolicyFailed {}
/** The server is not ready, is full, or cannot be reached. */
export class PolicyUnavailable extends VLAgentsError {}
export class NoReplica extends PolicyUnavailable {}
/** The connection broke during a request, which may have been executed. */
export class ConnectionLost extends PolicyUnavailable {}
/** No answer came in time; if the server said so, the request was not executed and never will be. */
export class DeadlineExceeded extends VLAgentsError {}
/** The deadline passed while the policy was at work on the request: the session counts the step, or is about to. */
export class OutcomeUnknown extends DeadlineExceeded {}

type ErrorClass = new (detail: string, code?: string, retryAfterS?: number) => VLAgentsError;

const BY_CODE: Record<string, ErrorClass> = {
  invalid_input: InvalidInput,
  malformed: MalformedMessage,
  too_large: MessageTooLarge,
  invalid_observation: InvalidObservation,
  missing_camera: MissingCamera,
  missing_state: MissingState,
  not_offered: NotOffered,
  unknown_session: UnknownSession,
  unknown_app: UnknownApp,
  unknown_checkpoint: UnknownCheckpoint,
  not_reset: NotReset,
  contract_mismatch: ContractMismatch,
  unauthorized: Unauthorized,
  forbidden: Forbidden,
  too_many_requests: TooManyRequests,
  overloaded: Overloaded,
  policy_failed: PolicyFailed,
  invalid_action: InvalidAction,
  checkpoint_failed: CheckpointFailed,
  unavailable: PolicyUnavailable,
  no_replica: NoReplica,
  connection_lost: ConnectionLost,
  deadline_exceeded: DeadlineExceeded,
  outcome_unknown: OutcomeUnknown,
};

/** Codes of answers that are no problem documents, by HTTP status. */
const BY_STATUS: Record<number, string> = {
  401: "unauthorized",
  403: "forbidden",
  404: "unavailable", // the proxy does not know the application yet
  413: "too_large",
  429: "too_many_requests",
  500: "connection_lost", // the proxy could not reach the replica any more
  502: "connection_lost",
  503: "no_replica",
  504: "connection_lost",
};

/** Return the error with a server's code and message; an unknown code gives a plain `VLAgentsError`. */
export function errorOf(code: string, detail: string, retryAfterS?: number): VLAgentsError {
  const known = Object.hasOwn(BY_CODE, code) ? BY_CODE[code] : undefined;
  return known === undefined ? new VLAgentsError(detail, "internal", retryAfterS) : new known(detail, code, retryAfterS);
}

/** Return the error that `error` of a reply, or a problem document, describes. */
export function errorFrom(document: unknown): VLAgentsError {
  if (typeof document !== "object" || document === null) {
    return new VLAgentsError(`got an error without a code: ${String(document).slice(0, 80)}`);
  }
  const { code, detail, retry_after_s: wait } = document as Record<string, unknown>;
  const retryAfterS = typeof wait === "number" && wait >= 0 ? wait : undefined;
  return errorOf(String(code ?? ""), String(detail ?? ""), retryAfterS);
}

/** Return the error of an HTTP answer with a status of 400 or more. */
export function errorOfAnswer(status: number, type: string, body: string, retryAfter?: string | null): VLAgentsError {
  const seconds = retryAfter === null || retryAfter === undefined ? Number.NaN : Number(retryAfter);
  if (type.startsWith("application/problem+json")) {
    try {
      const document: unknown = JSON.parse(body);
      if (typeof document === "object" && document !== null) {
        const wait = Number.isFinite(seconds) ? { retry_after_s: seconds } : {};
        return errorFrom({ ...wait, ...document });
      }
    } catch {
      // it is no JSON, whatever its type says
    }
  }
  const detail = `HTTP status ${status}: ${body.trim().slice(0, 200) || "no text"}`;
  return errorOf(BY_STATUS[status] ?? "internal", detail, Number.isFinite(seconds) ? seconds : undefined);
}
