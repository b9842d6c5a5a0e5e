"""Where the range filter's landmarks come from: recorded tracks, bearings, corners, chessboards and markers."""
