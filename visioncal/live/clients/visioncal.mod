MODULE Visioncal
    ! Tells visioncal that the arm stands at a stop, and waits until its picture is taken.
    ! Call VisioncalStop 1; VisioncalStop 2; ... in your own program after the motion to each stop
    ! (zone fine), and VisioncalEnd; after the last. Nothing here moves the arm.
    ! Option 616-1 PC Interface. Set the address of visioncal's computer and its port.
    ! Syntax: ABB, Technical reference manual, RAPID Instructions, Functions and Data types:
    ! SocketCreate, SocketConnect, SocketSend, SocketReceive, WaitRob, NumToStr. A string has at
    ! most 80 characters. Written by this manual; not run on a controller.
    LOCAL CONST string VC_HOST := "192.168.125.2";
    LOCAL CONST num VC_PORT := 30100;
    LOCAL VAR socketdev vcLink;
    LOCAL VAR bool vcOpen := FALSE;
    LOCAL VAR string vcAnswer := "";

    PROC VisioncalStop(num number)
        VAR robtarget here;
        VAR num tries := 0;
        WaitRob \ZeroSpeed;
        here := CRobT(\Tool:=tool0 \WObj:=wobj0);
        vcAnswer := "";
        WHILE vcAnswer <> "next" AND vcAnswer <> "done" DO
            IF tries > 0 THEN
                TPWrite "visioncal: " + vcAnswer;
                WaitTime 2;
            ENDIF
            IF tries >= 5 THEN
                ! Start tries again.
                Stop;
                tries := 0;
            ENDIF
            VcAsk number, here;
            tries := tries + 1;
        ENDWHILE
    ENDPROC

    PROC VisioncalEnd()
        SocketSend vcLink \Str:="end\0A";
        VcRead;
        SocketClose vcLink;
        vcOpen := FALSE;
    ERROR
        TRYNEXT;
    ENDPROC

    LOCAL PROC VcAsk(num number, robtarget here)
        vcAnswer := "";
        IF NOT vcOpen THEN
            SocketClose vcLink;
            SocketCreate vcLink;
            SocketConnect vcLink, VC_HOST, VC_PORT \Time:=10;
            vcOpen := TRUE;
        ENDIF
        SocketSend vcLink \Str:=NumToStr(number,0) + " | [[" + NumToStr(here.trans.x,3) + ",";
        SocketSend vcLink \Str:=NumToStr(here.trans.y,3) + "," + NumToStr(here.trans.z,3) + "],[";
        SocketSend vcLink \Str:=NumToStr(here.rot.q1,7) + "," + NumToStr(here.rot.q2,7) + ",";
        SocketSend vcLink \Str:=NumToStr(here.rot.q3,7) + "," + NumToStr(here.rot.q4,7) + "]]\0A";
        VcRead;
    ERROR
        ! The next try connects anew, and sends the same stop again.
        vcOpen := FALSE;
        vcAnswer := "";
        RETURN;
    ENDPROC

    LOCAL PROC VcRead()
        VAR string sign := "";
        vcAnswer := "";
        WHILE sign <> "\0A" DO
            SocketReceive vcLink \Str:=sign \ReadNoOfBytes:=1 \Time:=120;
            IF sign <> "\0A" AND StrLen(vcAnswer) < 60 THEN
                vcAnswer := vcAnswer + sign;
            ENDIF
        ENDWHILE
    ERROR
        RAISE;
    ENDPROC
ENDMODULE
